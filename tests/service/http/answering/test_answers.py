"""What the service answers: fixes of reports and batches, and what it says of its table and stations."""

import asyncio
import json
import math
import re
from pathlib import Path
from typing import Any

import httpx
import pytest

from rayfix_service.http.answering.locating import Answerer, Incoming
from rayfix_service.http.problems import Problem
from rayfix_service.wire import FixDocument
from rayfix_tables.table import Table
from tests.support.messages.measurements import TDOA, TOA
from tests.support.messages.reports import REPORT, changed
from tests.support.running.running_app import RunningApp

AOA, PT = REPORT["measurements"]


def test_a_report_becomes_a_fix(hall_app: RunningApp):
    response = hall_app.post("/v1/positions", REPORT)
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/json"
    fix = FixDocument.model_validate(response.json())
    assert (fix.target_id, fix.timestamp) == (REPORT["target_id"], REPORT["timestamp"])
    assert fix.position is not None
    # The example is of (7.0, 4.0, 1.5); at 8 m, the angles are good for 0.14 m and the range for 0.5 m.
    assert math.dist((fix.position.x, fix.position.y, fix.position.z), (7.0, 4.0, 1.5)) < 1.0
    assert [outcome.index for outcome in fix.measurements] == [0, 1]
    assert all(outcome.used for outcome in fix.measurements)
    assert fix.candidates[0].position == fix.position
    assert fix.candidates[0].covariance_m2 == fix.covariance_m2
    assert sum(candidate.probability for candidate in fix.candidates) <= 1.0 + 1e-9
    assert fix.compute_ms > 0.0


def test_the_fix_is_the_locators(hall_app: RunningApp, hall_table_path: Path):
    document = hall_app.post("/v1/positions", REPORT).json()
    table = hall_app.get("/v1/table").json()
    assert document["table_id"] == table["table_id"] == Table.open(hall_table_path).table_id


def test_the_same_report_gets_the_same_fix(hall_app: RunningApp):
    first, second = (hall_app.post("/v1/positions", REPORT).json() for _ in range(2))
    del first["compute_ms"], second["compute_ms"]
    assert first == second


def test_metres_and_nanoseconds_get_the_same_fix(hall_app: RunningApp):
    in_metres = hall_app.post("/v1/positions", changed(1, range_m=7.8, stdev_m=0.5)).json()
    c = 0.299792458  # m/ns
    nanoseconds = {"delay_ns": 7.8 / c, "stdev_ns": 0.5 / c}
    in_nanoseconds = hall_app.post("/v1/positions", changed(1, "range_m", "stdev_m", **nanoseconds)).json()
    for axis in "xyz":
        assert in_nanoseconds["position"][axis] == pytest.approx(in_metres["position"][axis], abs=1e-6)


@pytest.mark.parametrize(
    "content_type", ["application/json", "APPLICATION/JSON; charset=utf-8", "application/vnd.acme+json"]
)
def test_json_by_any_of_its_names_is_taken(hall_app: RunningApp, content_type: str):
    body = json.dumps(REPORT).encode()
    assert hall_app.post_bytes("/v1/positions", body, {"content-type": content_type}).status_code == 200


def test_reports_that_came_together_take_each_step_together(hall_app: RunningApp, monkeypatch: pytest.MonkeyPatch):
    steps = []
    locate, write = Answerer.locate, Answerer.write

    async def noting_locate(self: Answerer, table: Any, incoming: Incoming, wanted: Any) -> Any:
        steps.append(("locate", incoming.report.target_id))
        return await locate(self, table, incoming, wanted)

    def noting_write(self: Answerer, table: Any, incoming: Incoming, *rest: Any) -> Any:
        steps.append(("write", incoming.report.target_id))
        return write(self, table, incoming, *rest)

    async def together() -> list[httpx.Response]:
        reports = [REPORT | {"target_id": name} for name in "ab"]
        return await asyncio.gather(*(hall_app.http.post("/v1/positions", json=report) for report in reports))

    monkeypatch.setattr(Answerer, "locate", noting_locate)
    monkeypatch.setattr(Answerer, "write", noting_write)
    answers = hall_app.run(together())
    assert steps == [("locate", "a"), ("locate", "b"), ("write", "a"), ("write", "b")]
    assert [answer.json()["target_id"] for answer in answers] == ["a", "b"]


def test_a_batch_is_answered_in_its_order(hall_app: RunningApp):
    reports = [
        REPORT | {"target_id": "first"},
        {"measurements": []},
        changed(0, station_id="bs9"),
        7,
        REPORT | {"target_id": "last"},
    ]
    response = hall_app.post("/v1/positions/batch", {"reports": reports})
    assert response.status_code == 200
    first, empty, unknown, number, last = response.json()["results"]
    assert (first["target_id"], last["target_id"]) == ("first", "last")
    assert first["position"] == last["position"] == hall_app.post("/v1/positions", REPORT).json()["position"]
    assert [(p["status"], p["errors"][0]["path"]) for p in (empty, unknown, number)] == [
        (422, "measurements"),
        (422, "measurements[0].station_id"),
        (422, ""),
    ]
    for document in (empty, unknown, number):
        Problem.model_validate(document)


def test_a_batch_may_be_empty_or_as_large_as_allowed(hall_app: RunningApp):
    assert hall_app.post("/v1/positions/batch", {"reports": []}).json() == {"results": []}
    response = hall_app.post("/v1/positions/batch", {"reports": [0] * 1000})
    assert response.status_code == 200
    assert len(response.json()["results"]) == 1000


def together(app: RunningApp, *requests: tuple[str, str, Any]) -> list[tuple[str, httpx.Response]]:
    """Send requests at the same time; path and response of each, first answered first."""
    answered: list[tuple[str, httpx.Response]] = []

    async def send(method: str, path: str, document: Any) -> None:
        answered.append((path, await app.http.request(method, path, json=document)))

    async def send_all() -> None:
        await asyncio.gather(*(send(*request) for request in requests))

    app.run(send_all())
    return answered


def test_a_batch_lets_other_requests_in_between(hall_app: RunningApp):
    answered = together(hall_app, ("POST", "/v1/positions/batch", {"reports": [REPORT] * 50}), ("GET", "/livez", None))
    assert [path for path, _ in answered] == ["/livez", "/v1/positions/batch"]
    assert all(response.status_code == 200 for _, response in answered)


def test_a_long_report_lets_other_requests_in_between(hall_app: RunningApp):
    angle, *others = REPORT["measurements"]
    paths = [angle | {"azimuth_deg": angle["azimuth_deg"] + 0.1 * n} for n in range(12)]
    report = {"measurements": [*paths, *others * 12]}
    answered = together(hall_app, ("POST", "/v1/positions", report), ("GET", "/livez", None))
    assert [path for path, _ in answered] == ["/livez", "/v1/positions"]
    assert len(answered[1][1].json()["measurements"]) == 24


# name: measurements that the wire takes, though no instrument would send them
EXTREME: dict[str, list[dict[str, Any]]] = {
    "straight up": [AOA | {"zenith_deg": 0}],
    "straight down": [AOA | {"zenith_deg": 180}],
    "straight up, turned": [AOA | {"zenith_deg": 0, "frame": "lcs"}, AOA | {"station_id": "bs2"}],
    "smallest deviations": [
        AOA | {"azimuth_stdev_deg": 1e-6, "zenith_stdev_deg": 1e-6},
        PT | {"stdev_m": 1e-6},
    ],
    "largest deviations": [
        AOA | {"azimuth_stdev_deg": 360, "zenith_stdev_deg": 360},
        PT | {"stdev_m": 1e6},
    ],
    "a range beyond the table": [AOA, PT | {"range_m": 1e6}],
    "a negative range": [AOA, PT | {"range_m": -1e6}],
    "a clock far off": [AOA] + [TOA | {"station_id": s, "range_m": 1e12} for s in ("bs1", "bs2", "bs3")],
    "one time of arrival": [TOA],
    "an impossible difference": [TDOA | {"range_difference_m": 1e6}],
    "heavy tails": [
        AOA | {"error_model": "heavy_tailed", "tail_scale": 20},
        PT | {"error_model": "heavy_tailed", "tail_share": 0.5},
    ],
    "all but wholly correlated": [AOA | {"correlation": 0.999}, AOA | {"station_id": "bs2", "correlation": -0.999}],
    "contradicting angles": [AOA | {"azimuth_deg": azimuth} for azimuth in (-170, -80, 10, 100)],
}


@pytest.mark.parametrize("measurements", [*EXTREME.values()], ids=[*EXTREME])
def test_extreme_reports_are_answered(hall_app: RunningApp, measurements: list[dict[str, Any]]):
    response = hall_app.post("/v1/positions", {"measurements": measurements})
    assert response.status_code == 200
    fix = FixDocument.model_validate(response.json())
    assert len(fix.measurements) == len(measurements)
    assert all(outcome.used or outcome.reason for outcome in fix.measurements)
    assert (fix.position is None) == (not any(outcome.used for outcome in fix.measurements))
    for candidate in fix.candidates:
        assert 0.0 <= candidate.probability <= 1.0
        assert min(candidate.covariance_m2[i][i] for i in range(3)) > 0.0


def test_the_table_is_described(hall_app: RunningApp, hall_table_path: Path):
    table = Table.open(hall_table_path)
    document = hall_app.get("/v1/table").json()
    assert document["format_version"] == table.format_version
    assert document["software_version"] == table.software_version
    assert document["num_stations"] == 4
    assert document["num_components"] == sum(
        level.num_components for part in table.parts.values() for level in part.levels
    )
    assert document["site"] == {
        "name": table.site.name,
        "north_deg": pytest.approx(math.degrees(table.site.north)),
        "max_path_length_m": table.site.max_path_length,
    }


def test_the_stations_are_listed(hall_app: RunningApp, hall_table_path: Path):
    table = Table.open(hall_table_path)
    stations = hall_app.get("/v1/stations").json()["stations"]
    assert [station["id"] for station in stations] == ["bs1", "bs2", "bs3", "bs4"]
    for station in stations:
        part = table.parts[station["id"]]
        assert tuple(station["position"].values()) == part.station.position
        assert list(station["orientation"]) == ["bearing_deg", "downtilt_deg", "slant_deg"]
        assert station["mounting"] == "3gpp"
        assert station["boresight"]["azimuth_deg"] == pytest.approx(station["orientation"]["bearing_deg"])
        assert station["boresight"]["downtilt_deg"] == pytest.approx(station["orientation"]["downtilt_deg"])
        assert station["field_of_view_deg"] == pytest.approx(math.degrees(part.station.field_of_view))
        assert [level["num_cells"] for level in station["levels"]] == [level.num_cells for level in part.levels]
        windows = [level["window_deg"] for level in station["levels"]]
        assert windows == sorted(windows)
        assert windows == pytest.approx([math.degrees(level.window) for level in part.levels])


def turned_report(turn_deg: float) -> dict[str, Any]:
    """Angles and times of three stations that see (7, 4, 1.5), with azimuths counted from elsewhere."""
    seen = {"bs1": (29.47, 96.49, 7.97), "bs2": (103.0, 102.67, 4.10), "bs3": (-93.70, 93.70, 13.96)}
    measurements: list[dict[str, Any]] = []
    for name, (azimuth, zenith, length) in seen.items():
        deviations = {"azimuth_stdev_deg": 1.0, "zenith_stdev_deg": 1.0}
        angles = {"azimuth_deg": azimuth - turn_deg, "zenith_deg": zenith, **deviations}
        measurements.append({"type": "aoa", "station_id": name, **angles})
        measurements.append({"type": "pt", "station_id": name, "range_m": length, "stdev_m": 0.5})
    return {"measurements": measurements}


def test_an_inconsistent_fix_names_its_suspects_and_the_turn(hall_app: RunningApp):
    document = hall_app.post("/v1/positions", turned_report(40.0)).json()
    assert document["status"] == "inconsistent"
    suspects, turn = document["warnings"]
    assert re.search(r"the angle of station 'bs[123]' \(measurements\[\d\]\)", suspects)
    assert "the angles of all stations by +40 +- 1 deg" in turn
    omlox = hall_app.post("/v1/positions?output=omlox", turned_report(40.0)).json()
    assert omlox["properties"]["rayfix.warnings"] == document["warnings"]
    assert "warnings" not in hall_app.post("/v1/positions", turned_report(0.0)).json()
