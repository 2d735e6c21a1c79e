"""The files that tables come from: listed, and not opened."""

from dataclasses import dataclass
from pathlib import Path

from rayfix_tables.disk.files import FileState as PresentState
from rayfix_tables.disk.files import state_of, why_not_regular
from rayfix_tables.errors import TableError

FileState = PresentState | None
"""What distinguishes versions of a file: inode, size and time; None for a missing file."""


@dataclass(frozen=True, kw_only=True)
class FoundFiles:
    """Files of tables, by the tables' names.

    Attributes
    ----------
    files : dict of str to pathlib.Path
        Sorted.
    states : dict of str to FileState
    unfit : dict of str to str
        What is called ``*.h5`` and cannot be a table, by its name with escapes, and why.
    """

    files: dict[str, Path]
    states: dict[str, FileState]
    unfit: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class TableFiles:
    """Where tables come from: one file, or the ``*.h5`` of a folder."""

    path: Path

    def look(self) -> FoundFiles:
        """List the files and their versions.

        Raises
        ------
        OSError
            When the folder cannot be read.
        """
        if self.path.is_dir():
            # A file that is being written has another suffix or, as those of rsync, a dot before its name.
            paths = [path for path in sorted(self.path.glob("*.h5")) if not path.name.startswith(".")]
        else:
            paths = [self.path]
        files: dict[str, Path] = {}
        unfit: dict[str, str] = {}
        for path in paths:
            reason = why_unfit(path)
            if reason is None:
                files[path.stem] = path
            else:
                unfit[shown_name(path.stem)] = reason
        return FoundFiles(files=files, states={name: file_state(path) for name, path in files.items()}, unfit=unfit)

    def find(self) -> dict[str, Path]:
        """Return the files by the names of their tables, sorted.

        Raises
        ------
        TableError
            When a folder has none.
        """
        found = self.look()
        if not found.files:
            raise no_table(self.path, found)
        return found.files

    def states(self) -> dict[str, FileState]:
        """List the files and their versions; empty where the folder has none."""
        try:
            return self.look().states
        except OSError:
            return {}


def no_table(path: Path, found: FoundFiles) -> TableError:
    """Return the error of a path at which no file can be a table."""
    if found.unfit:
        return TableError(next(iter(found.unfit.values())))
    return TableError(f"there is no table in {path}; put files T.h5 that 'rayfix build' wrote there")


def why_unfit(path: Path) -> str | None:
    """Return why a file cannot be a table, from its name and kind alone; None for one that can."""
    if not path.stem.isprintable():  # names appear in logs, figures and answers
        return f"{shown_name(path.name)} has characters in its name that cannot be shown; rename it"
    try:
        what = why_not_regular(path)
    except OSError:  # reported when it is opened
        return None
    return None if what is None else f"{path} {what} and no table; take it away"


def shown_name(name: str) -> str:
    """Name of a file for messages: with escapes where it is no printable Unicode."""
    return name if name.isprintable() else ascii(name)[1:-1]


def file_state(path: Path) -> FileState:
    """Return what distinguishes this version of a file."""
    try:
        return state_of(path.stat())
    except OSError:
        return None
