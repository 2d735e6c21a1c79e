"""Prometheus metrics; docs/operations.md lists them."""

import os
import re
from pathlib import Path
from typing import get_args

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, values
from prometheus_client.exposition import choose_encoder
from prometheus_client.multiprocess import MultiProcessCollector

from rayfix_service.adapters.omlox_hub import HubOutcome
from rayfix_service.fusion.measurements.report import Report
from rayfix_service.fusion.posterior.fix import Fix, Status
from rayfix_service.http.problems import NOT_READY, ProblemError
from rayfix_service.http.telemetry.connections import CLOSED, Closed
from rayfix_service.http.telemetry.figure_files import ReservedDict
from rayfix_service.http.telemetry.report_figures import SECONDS, ReportFigures
from rayfix_service.http.telemetry.station_figures import OUTCOMES, StationFigures, outcome_name
from rayfix_service.tracking.track import TrackState
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

MULTIPROCESS_VARIABLE = "PROMETHEUS_MULTIPROC_DIR"
"""Environment variable of prometheus-client: folder for the metrics of several processes."""

_ACCEPTABLE = re.compile(
    r"[ \t]*[a-z*]+/[a-z*.+-]+"
    r"(?:[ \t]*;[ \t]*(?:version=\d{1,4}(?:\.\d{1,4}){0,2}|(?:escaping|charset|q)=[a-z0-9.-]+))*[ \t]*",
    re.ASCII | re.IGNORECASE,
)
"""An item of an Accept header that prometheus-client can parse; it raises an exception at others."""

_METHODS = {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"}


class Metrics:
    """The figures of one application, in a registry of its own.

    Attributes
    ----------
    reports : ReportFigures
        Reports by the way that they came.
    """

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self.reports = ReportFigures(self._registry)
        self._stations = StationFigures(self._registry)
        self._requests = Counter(
            "rayfix_http_requests",
            "HTTP requests by route, method and status",
            ("route", "method", "status"),
            registry=self._registry,
        )
        self._by_request: dict[tuple[str, str, str], tuple[Counter, Histogram]] = {}
        self._request_seconds = Histogram(
            "rayfix_http_request_seconds",
            "Time from a request's head to the end of its answer",
            ("route", "method"),
            buckets=SECONDS,
            registry=self._registry,
        )
        fixes = Counter("rayfix_fixes", "Fixes by status", ("status",), registry=self._registry)
        # All label values exist from the start with 0; otherwise a rate would miss the first event.
        self._fixes = {status: fixes.labels(status) for status in get_args(Status)}
        self._fusion_seconds = Histogram(
            "rayfix_fusion_seconds", "Time that a fix took to compute", buckets=SECONDS, registry=self._registry
        )
        measurements = Counter(
            "rayfix_measurements",
            "Measurements by what became of them: used, outlier (used, and more likely wrong than not) or unused",
            ("outcome",),
            registry=self._registry,
        )
        self._measurements = {name: measurements.labels(name) for name in OUTCOMES}
        tracks = Counter(
            "rayfix_tracks", "Reports by what they did to their target's track", ("state",), registry=self._registry
        )
        self._tracks = {state: tracks.labels(state) for state in get_args(TrackState)}
        told = Counter(
            "rayfix_omlox_locations",
            "Positions for the omlox hub by what became of them: sent, refused by the hub, or dropped",
            ("outcome",),
            registry=self._registry,
        )
        self._told = {outcome: told.labels(outcome) for outcome in get_args(HubOutcome)}
        messages = Counter(
            "rayfix_mqtt_messages",
            "Messages of the MQTT broker by what became of them: taken, repeated (delivered twice) or passed over",
            ("outcome",),
            registry=self._registry,
        )
        self._messages = {outcome: messages.labels(outcome) for outcome in ("taken", "repeated", "passed_over")}
        self._broker = Gauge(
            "rayfix_mqtt_connected",
            "1 while the MQTT broker is connected; absent where none is read",
            ("broker",),
            registry=self._registry,
            multiprocess_mode="livemax",
        )
        closed = Counter(
            "rayfix_connections_closed",
            "Connections that the service closed by itself, by the reason",
            ("reason",),
            registry=self._registry,
        )
        self._closed = {reason: closed.labels(reason) for reason in CLOSED}
        self._table = Gauge(
            "rayfix_table_info",
            "1 for each table that answers, 0 for those that did",
            ("table", "table_id", "site", "format_version", "software_version"),
            registry=self._registry,
            multiprocess_mode="livemax",
        )
        loads = Counter(
            "rayfix_table_loads",
            "Tables loaded and refused, at the start and since",
            ("outcome",),
            registry=self._registry,
        )
        self._loads = {outcome: loads.labels(outcome) for outcome in ("loaded", "refused")}
        self._refused = Gauge(
            "rayfix_tables_refused",
            "Tables' files that are refused as they are now",
            registry=self._registry,
            multiprocess_mode="livemax",
        )
        self._refused.set(0)
        self._ready = Gauge(
            "rayfix_ready", "1 once the service can locate", registry=self._registry, multiprocess_mode="livemin"
        )
        self._ready.set(0)
        ProcessCollector(registry=self._registry)

    def request_done(self, route: str, method: str, status: str, seconds: float) -> None:
        """Count a request."""
        method = method if method in _METHODS else "other"
        kind = (route, method, status)
        if (figures := self._by_request.get(kind)) is None:  # looking them up by labels takes a lock for each
            figures = self._requests.labels(*kind), self._request_seconds.labels(route, method)
            self._by_request[kind] = figures
        requests, request_seconds = figures
        requests.inc()
        request_seconds.observe(seconds)

    def fix_done(self, fix: Fix, seconds: float, *, table: str, site: SiteInfo, report: Report) -> None:
        """Count a fix and its measurements.

        Parameters
        ----------
        fix : Fix
        seconds : float
            That it took to compute.
        table : str
            Name of the table that answered.
        site : SiteInfo
            Of that table.
        report : Report
            That the fix answers.
        """
        self._fixes[fix.status].inc()
        self._fusion_seconds.observe(seconds)
        for outcome in fix.outcomes:
            self._measurements[outcome_name(outcome)].inc()
        self._stations.count(table, site, report, fix)

    def track_done(self, state: TrackState) -> None:
        """Count a report that was taken into a track."""
        self._tracks[state].inc()

    def hub_told(self, outcome: HubOutcome) -> None:
        """Count a position for the omlox hub."""
        self._told[outcome].inc()

    def broker_message(self, outcome: str) -> None:
        """Count a message of the MQTT broker."""
        self._messages[outcome].inc()

    def broker_connected(self, address: str, connected: bool) -> None:
        """Tell whether the MQTT broker is connected."""
        self._broker.labels(address).set(connected)

    def connection_closed(self, reason: Closed) -> None:
        """Count a connection that the service closed by itself."""
        self._closed[reason].inc()

    def table_loaded(self, name: str, table: Table) -> None:
        """Record that a table is served."""
        self._table.labels(*_table_labels(name, table)).set(1)
        self._loads["loaded"].inc()
        self._stations.add_table(name, table.site)

    def table_left(self, name: str, table: Table) -> None:
        """Record that a table is no longer served."""
        self._table.labels(*_table_labels(name, table)).set(0)

    def table_refused(self) -> None:
        """Count a table that did not pass its check."""
        self._loads["refused"].inc()

    def tables_refused(self, count: int) -> None:
        """Set the number of files that are refused at present."""
        self._refused.set(count)

    def became_ready(self) -> None:
        """Record that the service can locate."""
        self._ready.set(1)

    def exposition(self, accept: str) -> tuple[bytes, str]:
        """Export all metrics, including those of the other worker processes; returns text and media type.

        Parameters
        ----------
        accept : str
            The request's Accept header.

        Raises
        ------
        ProblemError
            When the folder of the workers' figures is gone.
        """
        registry = self._registry
        if MULTIPROCESS_VARIABLE in os.environ:
            registry = CollectorRegistry()
            try:
                MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
            except ValueError:
                raise ProblemError(
                    NOT_READY, "the folder of the workers' figures has been removed; start the service again"
                ) from None
        encode, media_type = choose_encoder(",".join(filter(_ACCEPTABLE.fullmatch, accept.split(","))))
        return encode(registry), media_type


def _table_labels(name: str, table: Table) -> tuple[str, ...]:
    return (name, table.table_id, table.site.name, str(table.format_version), table.software_version)


def share_figures() -> None:
    """Keep metrics that are created from now on in files of this process, in the folder of ``MULTIPROCESS_VARIABLE``.

    prometheus-client reads the variable when it is imported, which is before there are workers. Where the folder has no
    room or is gone, the figures of this process are in its memory, and a warning says so.
    """
    values.MmapedDict = ReservedDict  # type: ignore[attr-defined]
    values.ValueClass = values.get_value_class()  # type: ignore[no-untyped-call]


def forget_dead_workers() -> None:
    """Remove the gauges of processes that have ended from the common folder."""
    folder = os.environ.get(MULTIPROCESS_VARIABLE)
    if folder is None:
        return
    for path in Path(folder).glob("gauge_live*.db"):
        pid = path.stem.rpartition("_")[2]
        # mark_process_dead would fail when another worker removes the same file at the same time.
        if pid.isdecimal() and not _is_alive(int(pid)):
            path.unlink(missing_ok=True)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it is alive and belongs to another user
        pass
    return True
