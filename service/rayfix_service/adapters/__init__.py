"""Formats of other systems: their measurements in, their positions out. docs/formats.md describes them."""
