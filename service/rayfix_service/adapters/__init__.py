"""Formats of other systems: reads their measurements and writes their positions. docs/formats.md describes them."""
