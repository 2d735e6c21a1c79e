"""What a log is made of, reports and places that hold none, and what is made of it."""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rayfix.logs.layouts import Layout
from rayfix.logs.residuals import Residual
from rayfix_service.fusion.measurements.report import Height, Report
from rayfix_service.fusion.posterior.fix import Status
from rayfix_service.fusion.settings import FusionSettings

if TYPE_CHECKING:
    from rayfix_service.adapters.formats import OutputFormat

SHARDS = 16
"""Groups of targets; each is followed in one process, whatever the number of processes, so that tracks are the same."""


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


@dataclass(frozen=True, kw_only=True)
class Task:
    """How the reports of a log are located and written.

    Attributes
    ----------
    table_path : pathlib.Path
    table_id : str
        Of the table at that path.
    layout : {"jsonl", "csv", "geojson", "parquet"}
    output_format : {"native", "3gpp", "omlox"}
        Of JSON lines.
    height, confidence
        For reports without a height, and instead of the reports' confidence.
    track : bool
        Whether targets are followed.
    with_reports : bool
        Whether JSON lines hold each fix's report as well.
    settings : FusionSettings
    """

    table_path: Path
    table_id: str
    layout: Layout
    output_format: "OutputFormat" = "native"
    height: Height | None = None
    confidence: float | None = None
    track: bool = False
    with_reports: bool = False
    settings: FusionSettings = field(default_factory=FusionSettings)


@dataclass(frozen=True, kw_only=True)
class Located:
    """A fix as it is written, and what the summary takes of it."""

    place: Place
    text: bytes
    status: Status
    residuals: tuple[Residual, ...]


@dataclass(frozen=True, kw_only=True)
class Work:
    """An entry, and the newest time of the log up to it, s since 1970, by which targets are forgotten."""

    entry: Entry
    now: float


def shard_of(target_id: str | None) -> int:
    """Group of a target, the same in every process."""
    return hashlib.sha256((target_id or "").encode("utf-8", "surrogatepass")).digest()[0] % SHARDS
