"""Measurements behind the results in docs/. Run a benchmark in a checkout: ``python -m benchmarks.fusion.accuracy``."""
