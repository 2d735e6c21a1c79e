"""What may be wrong with the site or the sensors where the measurements of a report contradict each other."""
