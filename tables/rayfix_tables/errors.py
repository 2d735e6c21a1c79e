"""The errors that the table and both halves raise on purpose; ``rayfix.errors`` lists all of them.

::

    RayfixError                 root; ``str(error)`` is one line that names the cause and the remedy
    ├── SiteError               the site file: unreadable, unknown key, value out of range
    ├── SceneError              the mesh: missing, unreadable, empty, a station where none can be
    ├── BuildError              the offline job: no space left, no ray came back
    ├── TableError              a table file
    │   ├── NotATableError      not an HDF5 file, or another program's
    │   ├── FormatVersionError  written by an incompatible version of rayfix
    │   └── CorruptTableError   truncated, or a checksum does not match
    ├── ReportError             a report that cannot be used; ``path`` names the field
    └── SettingsError           settings of the fusion, the tracking or the client: a value out of range

Anything else that escapes is a defect of rayfix.
"""

__all__ = [
    "BuildError",
    "CorruptTableError",
    "FormatVersionError",
    "NotATableError",
    "RayfixError",
    "ReportError",
    "SceneError",
    "SettingsError",
    "SiteError",
    "TableError",
]


class RayfixError(Exception):
    """Root of all errors that rayfix raises on purpose."""


class SiteError(RayfixError):
    """The site file is missing, unreadable or not valid."""


class SceneError(RayfixError):
    """The scene is missing, unreadable, or does not fit the site."""


class BuildError(RayfixError):
    """The offline job cannot go on."""


class TableError(RayfixError):
    """A table file cannot be used."""


class NotATableError(TableError):
    """The file is not a rayfix table."""


class FormatVersionError(TableError):
    """The table was written in a format that this version does not read."""


class CorruptTableError(TableError):
    """The table is truncated or its content does not match its checksums."""


class ReportError(RayfixError):
    """A report that cannot be used.

    Parameters
    ----------
    message : str
        What is wrong and what to do about it.
    path : tuple of (str or int), optional
        Where in the report, e.g. ``("measurements", 0, "azimuth_deg")``.
    """

    def __init__(self, message: str, *, path: tuple[str | int, ...] = ()) -> None:
        super().__init__(message)
        self.path = path


class SettingsError(RayfixError, ValueError):
    """A setting is out of its range."""
