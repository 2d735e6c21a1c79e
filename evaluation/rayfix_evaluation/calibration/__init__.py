"""Calibration of stations from recorded reports."""
