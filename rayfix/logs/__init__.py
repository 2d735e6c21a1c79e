"""Recorded logs: reading them, locating their reports on all cores, writing fixes, and playing them to a service."""
