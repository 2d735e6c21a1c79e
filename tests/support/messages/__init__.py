"""Reports and other messages, and what is refused of them."""
