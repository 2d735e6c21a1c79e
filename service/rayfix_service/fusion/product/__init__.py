"""Factors of the stations and their product, the hypotheses."""
