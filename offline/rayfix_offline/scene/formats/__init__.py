"""Readers of scene files, one for each format; each returns objects with their transforms."""
