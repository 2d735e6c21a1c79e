"""The application composed of its parts, and the processes that serve it."""
