"""Accuracy, calibration and time of fixes and tracks."""
