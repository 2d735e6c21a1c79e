"""Comparison of the forward solver with another one, and angle errors of antenna arrays."""
