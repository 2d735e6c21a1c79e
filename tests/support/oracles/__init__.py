"""Independent computations that results are compared with."""
