"""The report of an evaluation: figures, tables, and the HTML page."""
