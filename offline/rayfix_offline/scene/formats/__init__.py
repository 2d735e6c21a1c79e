"""Scene files of all kinds, each read into objects with their places."""
