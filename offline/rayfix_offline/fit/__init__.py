"""Gaussian mixtures of the cells, fitted to pieces of rays."""
