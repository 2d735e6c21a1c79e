"""What whoever runs the service sees: figures, request identifiers, logs."""

import asyncio
import contextlib
import io
import json
import logging
import logging.config
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from rayfix_service.fusion.measurements.report import Range, Report, TimeDifference
from rayfix_service.fusion.posterior.fix import Candidate, Fix, Outcome
from rayfix_service.http.openapi.examples import (
    BATCH_EXAMPLES,
    NRPPA_BATCH_EXAMPLES,
    NRPPA_EXAMPLES,
    SILABS_BATCH_EXAMPLES,
    SILABS_EXAMPLES,
    UBLOX_EXAMPLES,
)
from rayfix_service.http.problems import NOT_FOUND, OVERLOADED, ProblemError
from rayfix_service.http.telemetry.logs import JsonFormatter, log_config
from rayfix_service.http.telemetry.metrics import Metrics
from rayfix_service.http.telemetry.report_figures import report_outcome
from rayfix_service.http.telemetry.request_context import ACCESS_LOGGER, REQUEST_ID, RequestContext, UnderWay
from rayfix_service.http.telemetry.station_figures import MOST_STATIONS
from rayfix_service.locator import Locator
from rayfix_tables.disk.schema import FORMAT_VERSION
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table
from tests.support.checkout import ROOT
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import RunningApp

SITE = SiteInfo(name="site", north=0.0, max_path_length=100.0, stations=(Station(id="a", position=(0.0, 0.0, 0.0)),))


@pytest.fixture(scope="module")
def service(hall_table_path: Path) -> Iterator[RunningApp]:
    """Return an application whose figures nobody else makes grow."""
    with RunningApp(hall_table_path) as service:
        yield service


def figures_of(service: RunningApp) -> dict[tuple[str, ...], float]:
    """Values by name and labels, in the order of their names."""
    text = service.get("/metrics").text
    return {
        (sample.name, *(sample.labels[key] for key in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def grown(service: RunningApp, act: Callable[[], Any]) -> dict[tuple[str, ...], float]:
    """Run something; by how much figures that it changed have grown, the times aside."""
    before = figures_of(service)
    act()
    after = figures_of(service)
    return {
        key: value - before.get(key, 0.0)
        for key, value in after.items()
        if value != before.get(key, 0.0) and not re.search("_sum|_bucket|_created|^process_", key[0])
    }


def own(figures: dict[tuple[str, ...], float]) -> dict[tuple[str, ...], float]:
    """Figures without those of reading the figures."""
    return {key: value for key, value in figures.items() if "/metrics" not in key}


def test_a_report_is_counted(service: RunningApp):
    def act() -> None:
        assert service.post("/v1/positions", REPORT).json()["status"] == "ok"

    assert own(grown(service, act)) == {
        ("rayfix_http_requests_total", "POST", "/v1/positions", "200"): 1,
        ("rayfix_http_request_seconds_count", "POST", "/v1/positions"): 1,
        ("rayfix_fixes_total", "ok"): 1,
        ("rayfix_fusion_seconds_count",): 1,
        ("rayfix_measurements_total", "used"): 2,
        ("rayfix_reports_total", "answered", "positions"): 1,
        ("rayfix_report_seconds_count", "positions"): 1,
        ("rayfix_station_measurements_total", "used", "bs1", "hall"): 2,
        ("rayfix_station_outlier_probability_total", "bs1", "hall"): pytest.approx(0.0, abs=0.5),
        ("rayfix_station_angle_residual_degrees_count", "bs1", "hall"): 1,
        ("rayfix_station_range_residual_meters_count", "bs1", "hall"): 1,
    }


def test_each_fix_of_a_batch_is_counted(service: RunningApp):
    batch = {"reports": [*BATCH_EXAMPLES["two_reports"]["value"]["reports"], {"measurements": []}]}
    figures = own(grown(service, lambda: service.post("/v1/positions/batch", batch)))
    assert figures["rayfix_http_requests_total", "POST", "/v1/positions/batch", "200"] == 1
    assert figures["rayfix_fusion_seconds_count",] == 2
    assert sum(value for key, value in figures.items() if key[0] == "rayfix_fixes_total") == 2
    lines = UBLOX_EXAMPLES["three_anchors"]["value"]
    text = {"content": lines, "headers": {"content-type": "text/plain"}}
    figures = own(grown(service, lambda: service.request("POST", "/v1/positions/ublox", **text)))
    assert figures["rayfix_measurements_total", "used"] == 3


def first(examples: dict[str, Any]) -> Any:
    return next(iter(examples.values()))["value"]


@pytest.mark.parametrize(
    ("path", "body", "source"),
    [
        ("positions", REPORT, "positions"),
        ("positions?output=native", REPORT, "positions"),
        ("positions/batch", {"reports": [REPORT]}, "batch"),
        ("positions/nrppa", first(NRPPA_EXAMPLES), "nrppa"),
        ("positions/nrppa/batch", first(NRPPA_BATCH_EXAMPLES), "nrppa_batch"),
        ("positions/silabs", first(SILABS_EXAMPLES), "silabs"),
        ("positions/silabs/batch", first(SILABS_BATCH_EXAMPLES), "silabs_batch"),
        ("positions/ublox", first(UBLOX_EXAMPLES), "ublox"),
    ],
)
def test_every_route_that_locates_is_counted(service: RunningApp, path: str, body: Any, source: str):
    text = body if isinstance(body, str) else json.dumps(body)
    headers = {"content-type": "text/plain" if isinstance(body, str) else "application/json"}
    figures = own(grown(service, lambda: service.request("POST", f"/v1/{path}", content=text, headers=headers)))
    counted = {key: value for key, value in figures.items() if key[0].startswith("rayfix_report")}
    number = figures["rayfix_fusion_seconds_count",]
    assert counted == {
        ("rayfix_reports_total", "answered", source): number,
        ("rayfix_report_seconds_count", source): number,
    }


def test_reports_that_are_refused_are_counted_one_by_one(service: RunningApp):
    def act() -> None:
        service.post("/v1/positions", {"measurements": []})
        stranger = {**REPORT, "measurements": [{**REPORT["measurements"][0], "station_id": "stranger"}]}
        answer = service.post("/v1/positions/batch", {"reports": [{"measurements": []}, stranger, REPORT]})
        assert answer.status_code == 200

    figures = own(grown(service, act))
    assert {key: value for key, value in figures.items() if key[0] == "rayfix_reports_total"} == {
        ("rayfix_reports_total", "refused", "positions"): 1,
        ("rayfix_reports_total", "refused", "batch"): 2,
        ("rayfix_reports_total", "answered", "batch"): 1,
    }


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (None, "answered"),
        (ReportError("of the sender"), "refused"),
        (ProblemError(NOT_FOUND, "of the sender"), "refused"),
        (ProblemError(OVERLOADED, "of the service"), "failed"),
        (RuntimeError("a defect"), "failed"),
        (asyncio.CancelledError(), "failed"),
    ],
)
def test_whose_fault_it_is_that_a_report_is_not_answered(error: BaseException | None, outcome: str):
    assert report_outcome(error) == outcome


def test_stations_without_end_are_one():
    metrics = Metrics()
    stations = tuple(Station(id=f"s{n}", position=(0.0, 0.0, 0.0)) for n in range(MOST_STATIONS + 50))
    site = replace(SITE, stations=stations)
    candidate = Candidate(probability=1.0, position=np.array([3.0, 4.0, 0.0]), covariance=np.eye(3))
    used = Outcome(used=True, outlier_probability=0.25)
    for station in stations:
        report = Report(measurements=(Range(station_id=station.id, path_length=7.0, stdev=1.0),))
        fix = Fix(status="ok", candidates=(candidate,), outcomes=(used,), log_evidence=0.0, table_id="")
        metrics.fix_done(fix, 0.003, table="t", site=site, report=report)
    text = metrics.exposition("")[0].decode()
    counted = re.findall(r'rayfix_station_measurements_total{outcome="used",station="(\w+)",table="\w+"} (\S+)', text)
    assert len(counted) == MOST_STATIONS + 1
    assert dict(counted) == {**{f"s{n}": "1.0" for n in range(MOST_STATIONS)}, "other": "50.0"}
    assert 'rayfix_station_outlier_probability_total{station="other",table="other"} 12.5\n' in text
    assert 'rayfix_station_range_residual_meters_bucket{le="1.0",station="s0",table="t"} 0.0\n' in text
    assert 'rayfix_station_range_residual_meters_bucket{le="2.0",station="s0",table="t"} 1.0\n' in text
    assert 'rayfix_station_range_residual_meters_sum{station="other",table="other"} 100.0\n' in text


def test_a_time_difference_counts_for_both_stations():
    metrics = Metrics()
    measured = TimeDifference(station_id="a", reference_station_id="b", length_difference=1.0, stdev=1.0)
    outcome = Outcome(used=True, outlier_probability=0.9)
    fix = Fix(status="inconsistent", candidates=(), outcomes=(outcome,), log_evidence=0.0, table_id="")
    metrics.fix_done(fix, 0.003, table="t", site=SITE, report=Report(measurements=(measured,)))
    text = metrics.exposition("")[0].decode()
    for station in "ab":
        assert f'rayfix_station_measurements_total{{outcome="outlier",station="{station}",table="t"}} 1.0\n' in text


@pytest.mark.parametrize(
    ("method", "path", "body", "route", "status"),
    [
        ("POST", "/v1/positions", {"measurements": []}, "/v1/positions", "422"),
        ("GET", "/v1/positions", None, "/v1/positions", "405"),
        ("GET", "/no/such/path/4711", None, "none", "404"),
        ("GET", "/livez", None, "/livez", "200"),
    ],
)
def test_refusals_are_counted_by_route_and_not_by_path(
    service: RunningApp, method: str, path: str, body: Any, route: str, status: str
):
    figures = own(grown(service, lambda: service.request(method, path, json=body)))
    assert figures == {
        ("rayfix_http_requests_total", method, route, status): 1,
        ("rayfix_http_request_seconds_count", method, route): 1,
        **({("rayfix_reports_total", "refused", "positions"): 1} if status == "422" else {}),
    }


def test_methods_without_end_are_one(service: RunningApp):
    figures = own(grown(service, lambda: service.request("BREW", "/livez")))
    assert {key[1] for key in figures} == {"other"}


def test_outcomes_of_measurements_are_told_apart():
    metrics = Metrics()
    outcomes = (
        Outcome(used=True, outlier_probability=0.2),
        Outcome(used=True, outlier_probability=0.9),
        Outcome(used=True, outlier_probability=0.7),
        Outcome(used=False, reason="why"),
    )
    fix = Fix(status="inconsistent", candidates=(), outcomes=outcomes, log_evidence=0.0, table_id="")
    measured = tuple(Range(station_id="a", path_length=1.0 + n, stdev=1.0) for n in range(4))
    metrics.fix_done(fix, 0.003, table="t", site=SITE, report=Report(measurements=measured))
    text = metrics.exposition("")[0].decode()
    for line in (
        'rayfix_measurements_total{outcome="used"} 1.0',
        'rayfix_measurements_total{outcome="outlier"} 2.0',
        'rayfix_measurements_total{outcome="unused"} 1.0',
        'rayfix_station_measurements_total{outcome="outlier",station="a",table="t"} 2.0',
        'rayfix_station_measurements_total{outcome="unused",station="a",table="t"} 1.0',
        'rayfix_station_range_residual_meters_count{station="a",table="t"} 0.0',  # of no position that is ok
        'rayfix_fixes_total{status="inconsistent"} 1.0',
        'rayfix_fusion_seconds_bucket{le="0.002"} 0.0',
        'rayfix_fusion_seconds_bucket{le="0.005"} 1.0',
    ):
        assert f"\n{line}\n" in text


def test_the_table_and_readiness_are_told(service: RunningApp, hall_table_path: Path):
    figures = figures_of(service)
    table = Table.open(hall_table_path)
    labels = (str(FORMAT_VERSION), "hall", table.software_version, "hall", table.table_id)
    assert table.format_version == FORMAT_VERSION
    assert figures["rayfix_table_info", *labels] == 1
    assert figures["rayfix_ready",] == 1
    assert figures["process_resident_memory_bytes",] > 1e6


def test_the_page_lists_every_figure(service: RunningApp):
    page = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `(rayfix_\w+)`", page, flags=re.MULTILINE))
    text = service.get("/metrics").text
    assert listed == {
        f"{family.name}_total" if family.type == "counter" else family.name
        for family in text_string_to_metric_families(text)
        if family.name.startswith("rayfix_") and not family.name.endswith("_created")
    }


def test_openmetrics_is_given_to_who_asks(service: RunningApp):
    response = service.get("/metrics", headers={"accept": "application/openmetrics-text; version=1.0.0"})
    assert response.headers["content-type"].startswith("application/openmetrics-text")
    assert response.text.endswith("# EOF\n")
    assert service.get("/metrics").headers["content-type"].startswith("text/plain")


@pytest.mark.parametrize("path", ["/livez", "/no/such/path", "/v1/positions"])
def test_a_request_id_is_echoed_or_made(service: RunningApp, path: str):
    given = service.get(path, headers={"x-request-id": "Root=1-67891233-abcdef012345678912345678"})
    assert given.headers["x-request-id"] == "Root=1-67891233-abcdef012345678912345678"
    made = {service.get(path).headers["x-request-id"] for _ in range(3)}
    assert len(made) == 3
    assert all(re.fullmatch("[0-9a-f]{32}", identifier) for identifier in made)


@pytest.mark.parametrize("unfit", ["", "two words", "x" * 129, '"quoted"', "caf\u00e9".encode("latin-1")])
def test_an_id_that_is_unfit_for_a_log_is_replaced(service: RunningApp, unfit: Any):
    response = service.get("/livez", headers={"x-request-id": unfit})
    assert re.fullmatch("[0-9a-f]{32}", response.headers["x-request-id"])


@pytest.mark.parametrize("query", ["", "?output=native"])  # past the router, and by it
def test_a_defect_is_logged_with_its_request(service: RunningApp, monkeypatch: pytest.MonkeyPatch, query: str):
    def fail(self: Locator, report: Any, **options: Any) -> Any:
        raise RuntimeError("a defect")

    counted = ("rayfix_http_requests_total", "POST", "/v1/positions", "500")
    before = figures_of(service).get(counted, 0)
    monkeypatch.setattr(Locator, "fuse", fail)
    log = io.StringIO()
    handler = logging.StreamHandler(log)
    handler.setFormatter(JsonFormatter())
    logger = logging.getLogger("rayfix_service")
    logger.addHandler(handler)
    try:
        response = service.post(f"/v1/positions{query}", REPORT, headers={"x-request-id": "r-9"})
    finally:
        logger.removeHandler(handler)
    assert response.status_code == response.json()["status"] == 500
    assert response.headers["content-type"] == "application/problem+json"
    assert response.headers["x-request-id"] == "r-9"
    (entry,) = map(json.loads, log.getvalue().splitlines())
    assert (entry["level"], entry["request_id"]) == ("ERROR", "r-9")
    assert entry["message"] == "request POST /v1/positions failed"
    assert "RuntimeError: a defect" in entry["exception"]
    assert REQUEST_ID.get() is None
    assert figures_of(service)[counted] == before + 1


@pytest.mark.parametrize(
    ("sent", "raised"),
    [
        (1, True),  # the client must see the connection end, not an answer that is whole
        (2, False),
    ],
)
def test_a_defect_after_an_answer_has_begun(sent: int, raised: bool, caplog: pytest.LogCaptureFixture):
    answer = [{"type": "http.response.start", "status": 200}, {"type": "http.response.body", "body": b"{}"}]
    scope = {"type": "http", "method": "GET", "path": "/", "headers": []}
    received = []

    async def fail(scope: Any, receive: Any, send: Any) -> None:
        for message in answer[:sent]:
            await send(message)
        raise RuntimeError("a defect")

    async def receive() -> Any:
        raise AssertionError

    async def send(message: Any) -> None:
        received.append(message["type"])

    context = RequestContext(fail, metrics=Metrics(), under_way=UnderWay())
    with pytest.raises(RuntimeError) if raised else contextlib.nullcontext():
        asyncio.run(context(scope, receive, send))
    assert received == [message["type"] for message in answer[:sent]]
    assert len(caplog.records) == (0 if raised else 1)  # what is raised, the server logs


def test_a_line_per_request_is_written_on_demand(service: RunningApp, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, logger=ACCESS_LOGGER):
        service.get("/livez", headers={"x-request-id": "r-2"})
    (record,) = caplog.records
    assert re.fullmatch(r"GET /livez 200 in \d+\.\d ms, request r-2", record.getMessage())
    caplog.clear()
    with caplog.at_level(logging.WARNING, logger=ACCESS_LOGGER):
        service.get("/livez")
    assert caplog.records == []


def test_a_record_as_json():
    record = logging.LogRecord("a.b", logging.WARNING, "file", 1, 'line "%s"\n', ("x",), None)
    record.created = 1769853600.25
    record.fields = {"seconds": 0.5, "where": Path("/tmp")}
    assert json.loads(JsonFormatter().format(record)) == {
        "time": "2026-01-31T10:00:00.250Z",
        "level": "WARNING",
        "logger": "a.b",
        "message": 'line "x"\n',
        "seconds": 0.5,
        "where": "/tmp",
    }
    assert "\n" not in JsonFormatter().format(record)


@pytest.mark.parametrize(("access_log", "level"), [(True, "INFO"), (False, "WARNING")])
def test_the_configurations_of_logs_are_valid(access_log: bool, level: str):
    for log_format in ("text", "json"):
        config = log_config(log_format, access_log=access_log)  # type: ignore[arg-type]
        assert config["loggers"][ACCESS_LOGGER]["level"] == level
        logging.config.DictConfigurator(config)
