"""The viewer in the browser, and its routes of the service."""
