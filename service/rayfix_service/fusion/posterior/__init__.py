"""The posterior of the position: modes, candidates, outliers, regions and the fix."""
