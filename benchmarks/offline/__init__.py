"""Fits, builds and updates: quality, time, memory and size."""
