"""Code of several benchmarks."""
