"""The reports of one or several logs, one after another."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rayfix.logs.combining import Combine, joined
from rayfix.logs.csv_logs import CsvColumns, csv_entries
from rayfix.logs.entries import Entry, Problem
from rayfix.logs.files import LogFile, open_log
from rayfix.logs.joined_lines import has_topics, silabs_topic_entries, ublox_entries
from rayfix.logs.json_logs import json_elements, native_entries
from rayfix_service.adapters.ublox import USUAL_ERRORS, AngleErrors
from rayfix_tables.errors import ReportError

if TYPE_CHECKING:
    from rayfix_service.adapters.formats import InputFormat


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How logs are read.

    Attributes
    ----------
    input_format : {"native", "nrppa", "silabs", "ublox"}
        Native logs are JSON or CSV.
    columns : CsvColumns
        Of logs in CSV.
    stations : Mapping
        Stations by their names in the log.
    errors : AngleErrors
        Of u-blox anchors.
    window : float, s, optional
        Packets of a target within this time are one report.
    combine : {"median", "mean", "none"}
        What becomes of their measurements.
    """

    input_format: "InputFormat" = "native"
    columns: CsvColumns = field(default_factory=CsvColumns)
    stations: Mapping[str, str] = field(default_factory=dict)
    errors: AngleErrors = USUAL_ERRORS
    window: float | None = None
    combine: Combine = "median"


@dataclass
class ReadState:
    """What has become of the logs so far.

    Attributes
    ----------
    num_bytes : int
        That have been read, as they are in the files.
    unread_columns : list of str
        Columns of CSV logs that are not read.
    """

    num_bytes: int = 0
    unread_columns: list[str] = field(default_factory=list)


def read_logs(paths: Sequence[Path], reading: Reading, state: ReadState | None = None) -> Iterator[Entry | Problem]:
    """Give the reports of logs in their order; what is none is a problem, and the reading goes on.

    Raises
    ------
    ReportError
        When a log cannot be read at all.
    """
    state = state if state is not None else ReadState()
    entries = _entries(paths, reading, state)
    if reading.window is None:
        return entries
    return joined(entries, reading.window, reading.combine)


def _entries(paths: Sequence[Path], reading: Reading, state: ReadState) -> Iterator[Entry | Problem]:
    before = 0
    for path in paths:
        with open_log(path) as log:
            for entry in _of_one(log, reading, state):
                state.num_bytes = before + log.bytes_read
                yield entry
        before += path.stat().st_size
        state.num_bytes = before


def _of_one(log: LogFile, reading: Reading, state: ReadState) -> Iterator[Entry | Problem]:
    match reading.input_format:
        case "ublox":
            return ublox_entries(log, stations=reading.stations, errors=reading.errors)
        case "silabs" if has_topics(log):
            return silabs_topic_entries(log, stations=reading.stations)
        case "silabs" | "nrppa":
            return _messages(log, reading)
        case "native":
            return _native(log, reading, state)


def _native(log: LogFile, reading: Reading, state: ReadState) -> Iterator[Entry | Problem]:
    begin = log.head().removeprefix(b"\xef\xbb\xbf").lstrip()[:4096]
    if begin[:1] in (b"{", b"["):
        if reading.stations:
            raise ReportError("a native report names the stations of the table; --station is for other logs")
        if reading.columns.names or reading.columns.values:
            raise ReportError(f"{log.path} is JSON; --column and --value are for logs in CSV")
        return native_entries(log)
    if b"+UUDF:" in begin:
        raise ReportError(f"{log.path} has lines of u-blox anchors; give --format ublox")
    return csv_entries(log, reading.columns, stations=reading.stations, unread=state.unread_columns)


def _messages(log: LogFile, reading: Reading) -> Iterator[Entry | Problem]:
    """Give the reports of other systems' messages in JSON."""
    from rayfix_service.adapters.formats import parse  # its formats of answers have kernels

    for found in json_elements(log):
        if isinstance(found, Problem):
            yield found
            continue
        place, text = found
        try:
            for adapted in parse(text, reading.input_format, stations=reading.stations):
                yield Entry(place=place, report=adapted.report)
        except ReportError as error:
            yield Problem(place=place, text=str(error))
