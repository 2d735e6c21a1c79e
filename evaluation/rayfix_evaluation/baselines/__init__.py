"""Other methods of locating, which rayfix is compared with."""
