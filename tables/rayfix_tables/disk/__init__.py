"""How a table is stored: the file's layout and schema, its values, and whose file it is."""
