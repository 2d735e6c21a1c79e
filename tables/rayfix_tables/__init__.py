"""The table: grid, mixtures, file format, reading, writing, verifying. Knows nothing of the other packages."""
