"""Attacks on the service, bounded in number and time; each ends with status 1 if a bound does not hold."""
