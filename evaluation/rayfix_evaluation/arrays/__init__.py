"""Antenna arrays: estimation of a station's angles, and the errors of the estimates."""
