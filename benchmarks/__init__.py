"""What the figures in docs/ come from. Run a benchmark in a checkout: ``python -m benchmarks.fusion.accuracy``."""
