"""Scenes and sites that tests build, and readings of scene files that share no code with the readers."""
