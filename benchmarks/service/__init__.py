"""Load, capacity and streams of the running service."""
