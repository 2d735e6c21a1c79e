"""Components in few bytes, as a table holds them since version 5 of its format."""
