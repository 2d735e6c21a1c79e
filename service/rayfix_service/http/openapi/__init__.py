"""Examples and responses of the OpenAPI document."""
