"""What a report says: measurements, their error models, clocks and directions."""
