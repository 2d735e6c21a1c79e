"""Logs in CSV: a measurement, or all of a station, in each row."""

import csv
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches

from rayfix.logs.columns import COLUMNS, RowHead, head_of, measurements_of
from rayfix.logs.entries import Entry, Place, Problem
from rayfix.logs.files import LONGEST, LogFile
from rayfix_service.fusion.measurements.report import Measurement, Report
from rayfix_service.wire.documents import MAX_MEASUREMENTS
from rayfix_tables.errors import ReportError


@dataclass(frozen=True, kw_only=True)
class CsvColumns:
    """How the columns of a log are called.

    Attributes
    ----------
    names : Mapping
        Name in the log of each column that has another name there.
    values : Mapping
        Values of columns that the log does not have, the same for all rows.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)


def column_pairs(pairs: Iterable[str], option: str) -> dict[str, str]:
    """Read ``COLUMN=...`` of the command line.

    Raises
    ------
    ReportError
        When a pair has another form, or the column is none that is read.
    """
    found = {}
    for pair in pairs:
        name, equals, other = pair.partition("=")
        if not (name and equals and other):
            raise ReportError(f"{option} is {pair!r}; give COLUMN=..., e.g. azimuth_deg=az")
        if name not in COLUMNS:
            near = get_close_matches(name, COLUMNS, 1)
            hint = f"did you mean {near[0]}?" if near else "docs/logs.md lists those that are read"
            raise ReportError(f"{option} names the column {name!r}, which is none that is read; {hint}")
        found[name] = other
    return found


def csv_entries(
    log: LogFile, columns: CsvColumns, *, stations: Mapping[str, str], unread: list[str]
) -> Iterator[Entry | Problem]:
    """Give the reports of a log: rows next to each other of the same report are one.

    Parameters
    ----------
    log : LogFile
    columns : CsvColumns
    stations : Mapping
        Stations by their names in the log, of those that have others there.
    unread : list of str
        The log's columns that are not read are added to it.

    Raises
    ------
    ReportError
        When the log has no column that is read, or not one that was named.
    """
    lines = log.lines()
    header: list[str] = []
    for _, line in lines:
        text = line.decode("utf-8-sig", "replace").strip()
        if text:
            separator = max(",;\t", key=text.count)
            header = [name.strip() for name in next(csv.reader([text], delimiter=separator))]
            break
    if not header:
        return
    places = _places(header, columns, log.name)
    taken = set(places.values())
    unread += [name for n, name in enumerate(header) if n not in taken and name]
    constant = dict(columns.values)
    rows = _Rows(log.name)
    for number, line in lines:
        if not line.strip():
            continue
        if len(line) > LONGEST:
            yield Problem(place=Place(log.name, number), text=f"the line has more than {LONGEST} bytes; split it")
            continue
        try:
            fields = next(csv.reader([line.decode("utf-8", "replace").rstrip("\r\n")], delimiter=separator))
            if len(fields) != len(header):
                raise ReportError(f"the row has {len(fields)} fields; the first line names {len(header)} columns")
            row = constant | {name: fields[n].strip() for name, n in places.items() if fields[n].strip()}
            head, measured = head_of(row), measurements_of(row, stations)
        except (ReportError, csv.Error) as error:
            yield Problem(place=Place(log.name, number), text=str(error))
            continue
        yield from rows.add(number, head, measured)
    yield from rows.flush()


def _places(header: list[str], columns: CsvColumns, log: str) -> dict[str, int]:
    """Index of each column that is read."""
    for name, other in columns.names.items():
        if other not in header:
            raise ReportError(f"{log} has no column {other!r} for {name}; it has {', '.join(header)}")
    renamed = set(columns.names.values())
    places = {name: header.index(other) for name, other in columns.names.items()}
    # A column that stands for another one is not also read by its own name.
    for n, name in enumerate(header):
        if name in COLUMNS and name not in places and name not in renamed and name not in columns.values:
            places[name] = n
    if not places:
        raise ReportError(
            f"{log} has no column that is read, only {', '.join(header)[:200]}; name them by --column, "
            "e.g. --column azimuth_deg=az (docs/logs.md lists the columns)"
        )
    return places


class _Rows:
    """Gathers rows into reports."""

    def __init__(self, log: str) -> None:
        self._log = log
        self._head: RowHead | None = None
        self._begin = 0
        self._measured: list[Measurement] = []

    def add(self, number: int, head: RowHead, measured: list[Measurement]) -> Iterator[Entry | Problem]:
        """Take a row; give the report that ends before it."""
        timeless = head.key == (None, None)
        if self._head is None or head.key != self._head.key or (timeless and self._repeats(measured)):
            yield from self.flush()
            self._head, self._begin = head, number
        self._measured += measured

    def flush(self) -> Iterator[Entry | Problem]:
        """Give the report that has not ended."""
        head, measured, place = self._head, self._measured, Place(self._log, self._begin)
        self._head, self._measured = None, []
        if head is None:
            return
        if len(measured) > MAX_MEASUREMENTS:
            yield Problem(place=place, text=f"the report has {len(measured)} measurements, at most {MAX_MEASUREMENTS}")
            return
        report = Report(
            measurements=tuple(measured),
            height=head.height,
            confidence=head.confidence,
            target_id=head.target_id,
            timestamp=head.timestamp,
        )
        yield Entry(place=place, report=report)

    def _repeats(self, measured: list[Measurement]) -> bool:
        """Whether a station measures again, which begins a report where rows have neither target nor time."""
        heard = {(type(m), m.station_id) for m in self._measured}
        return any((type(m), m.station_id) in heard for m in measured)
