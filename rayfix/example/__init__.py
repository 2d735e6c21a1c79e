"""The bundled example hall."""
