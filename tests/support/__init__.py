"""What several test modules use, and fixtures are not made for."""
