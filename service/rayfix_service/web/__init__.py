"""The browser viewer and its HTTP routes."""
