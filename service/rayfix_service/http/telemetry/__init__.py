"""Metrics, logs and the identity of each request."""
