"""The HTTP service: routes, problems, and the server."""
