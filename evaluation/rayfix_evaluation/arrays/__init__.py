"""Antenna arrays: where a station's angles come from, and how wrong they are."""
