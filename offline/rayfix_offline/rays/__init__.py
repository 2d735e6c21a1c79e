"""Rays of a station: launched, reflected, cut into pieces and weighted by the path prior."""
