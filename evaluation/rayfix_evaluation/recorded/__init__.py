"""Recorded fixes beside the truth."""
