"""Reads scene files into triangles with materials, and finds the triangles that rays hit."""
