"""The table: grid, mixtures, file format, reading, writing, verifying. Knows nothing of the other packages.

Of it, ``rayfix.Table`` and the errors are public (see :mod:`rayfix`); the rest is for the other packages and may change
without notice.
"""
