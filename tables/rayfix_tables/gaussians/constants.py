"""Constants of Gaussian densities."""

LOG_2PI = 1.8378770664093453
"""Natural logarithm of 2 pi."""
