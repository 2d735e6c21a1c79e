"""The content of a report: measurements, their error models, clocks and directions."""
