"""Simulated drops: reports of a UE at known positions, their fixes, errors, bounds and calibration."""
