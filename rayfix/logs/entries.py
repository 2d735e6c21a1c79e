"""What a log is made of: reports, and places that hold none."""

from dataclasses import dataclass
from typing import NamedTuple

from rayfix_service.fusion.measurements.report import Report


class Place(NamedTuple):
    """Where in the logs something stands.

    Attributes
    ----------
    log : str
        Name of the file, without its folder.
    entry : int
        Line of the file, or number of the element of an array, from 1 on.
    """

    log: str
    entry: int

    def __str__(self) -> str:
        """Write it as compilers do."""
        return f"{self.log}:{self.entry}"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A report of a log.

    Attributes
    ----------
    place : Place
        Where the report begins.
    report : Report or bytes
        Bytes are the text of a native report that nobody has read yet.
    """

    place: Place
    report: Report | bytes


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A place of a log that gives no fix.

    Attributes
    ----------
    place : Place
    text : str
        What is wrong there, and what to do about it.
    """

    place: Place
    text: str
