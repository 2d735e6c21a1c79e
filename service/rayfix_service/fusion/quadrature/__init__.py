"""The posterior on a grid that is fine where it needs to be: exact for wide errors, where Gaussian tubes are not."""
