"""The forward solver: every path between a station and a point, by the image method, independent of the launcher."""
