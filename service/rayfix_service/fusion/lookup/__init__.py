"""Cells of the table that answer an angle."""
