"""Composition of the application, and the processes that serve it."""
