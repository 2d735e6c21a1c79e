"""Angles, frames, and how arrays are mounted."""
