"""Compiled operations on Gaussians that building and locating share."""
