"""Benchmarks on recorded data that are no part of this repository."""
