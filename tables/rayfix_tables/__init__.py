"""The table: grid, mixtures, file format, reading, writing, verifying. It imports none of the other packages.

``rayfix.Table`` and the errors are public (see :mod:`rayfix`). Everything else is for the other packages and may change
without notice.
"""
