"""The viewer in the browser, and what it asks the service for beyond fixes."""
