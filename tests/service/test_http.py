"""The HTTP service over a table of the bundled hall: answers, refusals, readiness, and a real server."""

import asyncio
import copy
import json
import logging
import math
import re
import threading
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import h5py
import httpx
import pytest
from fastapi import FastAPI

from rayfix_service.fusion.locator import Locator
from rayfix_service.http.app import create_app
from rayfix_service.http.examples import (
    BATCH_EXAMPLES,
    NRPPA_EXAMPLES,
    PROBLEM_EXAMPLE,
    REPORT_EXAMPLES,
    SILABS_EXAMPLES,
    UBLOX_EXAMPLES,
)
from rayfix_service.http.problems import KINDS, Problem
from rayfix_service.http.server import serve
from rayfix_service.http.settings import BodyLimits, ServiceSettings
from rayfix_service.wire import FixDocument
from rayfix_tables.errors import TableError
from rayfix_tables.table import Table

JSON = {"content-type": "application/json"}
REPORT: dict[str, Any] = REPORT_EXAMPLES["angle_and_time"]["value"]
AOA, PT = REPORT["measurements"]
TOA = {"type": "toa", "station_id": "bs2", "range_m": 131.0, "stdev_m": 0.5}
TDOA = {
    "type": "tdoa",
    "station_id": "bs2",
    "reference_station_id": "bs1",
    "range_difference_m": -4.1,
    "stdev_m": 0.5,
}


class Client:
    """An application and its loop, for tests that are not coroutines.

    Starlette's own test client warns about the httpx it finds, and warnings are errors here.
    """

    def __init__(self, app: FastAPI) -> None:
        self.app = app
        self._runner = asyncio.Runner()
        self._lifespan = app.router.lifespan_context(app)
        self._http = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test")

    def __enter__(self) -> "Client":
        """Start the application."""
        try:
            self._runner.run(self._lifespan.__aenter__())
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Stop it."""
        self._runner.run(self._lifespan.__aexit__(None, None, None))
        self._close()

    def _close(self) -> None:
        self._runner.run(self._http.aclose())
        self._runner.close()

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send one request and wait for the answer."""
        return self._runner.run(self._http.request(method, path, **options))

    def get(self, path: str) -> httpx.Response:
        """GET."""
        return self.request("GET", path)

    def post(self, path: str, document: Any) -> httpx.Response:
        """POST a document as JSON."""
        return self.request("POST", path, json=document)

    def post_bytes(self, path: str, content: Any, headers: dict[str, str] | None = None) -> httpx.Response:
        """POST a body as it is, as JSON unless the headers say otherwise."""
        return self.request("POST", path, content=content, headers=JSON if headers is None else headers)

    def together(self, *requests: tuple[str, str, Any]) -> list[tuple[str, httpx.Response]]:
        """Send requests at the same time; path and response of each, first answered first."""
        answered: list[tuple[str, httpx.Response]] = []

        async def send(method: str, path: str, document: Any) -> None:
            answered.append((path, await self._http.request(method, path, json=document)))

        async def send_all() -> None:
            await asyncio.gather(*(send(*request) for request in requests))

        self._runner.run(send_all())
        return answered

    def wait_until_ready(self, seconds: float = 100.0) -> None:
        """Wait until ``/readyz`` is 200."""
        deadline = time.monotonic() + seconds
        while (response := self.get("/readyz")).status_code != 200:
            assert "retry-after" in response.headers, response.text  # else it has failed for good
            assert time.monotonic() < deadline, "not ready in time"
            self._runner.run(asyncio.sleep(0.02))


@pytest.fixture(scope="module")
def client(hall_table_path: Path) -> Iterator[Client]:
    with Client(create_app(hall_table_path)) as client:
        client.wait_until_ready()
        yield client


def problem(response: httpx.Response, status: int) -> dict[str, Any]:
    """Check that a response is a problem document of that status, and return it."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert list(document) == ["type", "title", "status", "detail", "errors"]
    (kind,) = (kind for kind in KINDS if kind.uri == document["type"])
    assert (document["title"], document["status"]) == (kind.title, status)
    assert kind.status == status
    assert document["detail"]
    assert "\n" not in document["detail"]
    for error in document["errors"]:
        assert list(error) == ["path", "message"]
        assert error["message"]
    return document


def changed(index: int, *without: str, **values: Any) -> dict[str, Any]:
    """Return the example report with one measurement changed."""
    report = copy.deepcopy(REPORT)
    measurement = report["measurements"][index]
    for key in without:
        del measurement[key]
    measurement.update(values)
    return report


# --- answers ---------------------------------------------------------------------------------------------


def test_a_report_becomes_a_fix(client: Client):
    response = client.post("/v1/positions", REPORT)
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


def test_the_fix_is_the_locators(client: Client, hall_table_path: Path):
    document = client.post("/v1/positions", REPORT).json()
    table = client.get("/v1/table").json()
    assert document["table_id"] == table["table_id"] == Table.open(hall_table_path).table_id


def test_the_same_report_gets_the_same_fix(client: Client):
    first, second = (client.post("/v1/positions", REPORT).json() for _ in range(2))
    del first["compute_ms"], second["compute_ms"]
    assert first == second


def test_metres_and_nanoseconds_get_the_same_fix(client: Client):
    in_metres = client.post("/v1/positions", changed(1, range_m=7.8, stdev_m=0.5)).json()
    c = 0.299792458  # m/ns
    nanoseconds = {"delay_ns": 7.8 / c, "stdev_ns": 0.5 / c}
    in_nanoseconds = client.post("/v1/positions", changed(1, "range_m", "stdev_m", **nanoseconds)).json()
    for axis in "xyz":
        assert in_nanoseconds["position"][axis] == pytest.approx(in_metres["position"][axis], abs=1e-6)


@pytest.mark.parametrize(
    "content_type", ["application/json", "APPLICATION/JSON; charset=utf-8", "application/vnd.acme+json"]
)
def test_json_by_any_of_its_names_is_taken(client: Client, content_type: str):
    body = json.dumps(REPORT).encode()
    assert client.post_bytes("/v1/positions", body, {"content-type": content_type}).status_code == 200


def test_a_batch_is_answered_in_its_order(client: Client):
    reports = [
        REPORT | {"target_id": "first"},
        {"measurements": []},
        changed(0, station_id="bs9"),
        7,
        REPORT | {"target_id": "last"},
    ]
    response = client.post("/v1/positions/batch", {"reports": reports})
    assert response.status_code == 200
    first, empty, unknown, number, last = response.json()["results"]
    assert (first["target_id"], last["target_id"]) == ("first", "last")
    assert first["position"] == last["position"] == client.post("/v1/positions", REPORT).json()["position"]
    assert [(p["status"], p["errors"][0]["path"]) for p in (empty, unknown, number)] == [
        (422, "measurements"),
        (422, "measurements[0].station_id"),
        (422, ""),
    ]
    for document in (empty, unknown, number):
        Problem.model_validate(document)


def test_a_batch_may_be_empty_or_as_large_as_allowed(client: Client):
    assert client.post("/v1/positions/batch", {"reports": []}).json() == {"results": []}
    response = client.post("/v1/positions/batch", {"reports": [0] * 1000})
    assert response.status_code == 200
    assert len(response.json()["results"]) == 1000


def test_a_batch_lets_other_requests_in_between(client: Client):
    answered = client.together(("POST", "/v1/positions/batch", {"reports": [REPORT] * 50}), ("GET", "/livez", None))
    assert [path for path, _ in answered] == ["/livez", "/v1/positions/batch"]
    assert all(response.status_code == 200 for _, response in answered)


def test_a_long_report_lets_other_requests_in_between(client: Client):
    angle, *others = REPORT["measurements"]
    paths = [angle | {"azimuth_deg": angle["azimuth_deg"] + 0.1 * n} for n in range(12)]
    report = {"measurements": [*paths, *others * 12]}
    answered = client.together(("POST", "/v1/positions", report), ("GET", "/livez", None))
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
def test_extreme_reports_are_answered(client: Client, measurements: list[dict[str, Any]]):
    response = client.post("/v1/positions", {"measurements": measurements})
    assert response.status_code == 200
    fix = FixDocument.model_validate(response.json())
    assert len(fix.measurements) == len(measurements)
    assert all(outcome.used or outcome.reason for outcome in fix.measurements)
    assert (fix.position is None) == (not any(outcome.used for outcome in fix.measurements))
    for candidate in fix.candidates:
        assert 0.0 <= candidate.probability <= 1.0
        assert min(candidate.covariance_m2[i][i] for i in range(3)) > 0.0


def test_the_table_is_described(client: Client, hall_table_path: Path):
    table = Table.open(hall_table_path)
    document = client.get("/v1/table").json()
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


def test_the_stations_are_listed(client: Client, hall_table_path: Path):
    table = Table.open(hall_table_path)
    stations = client.get("/v1/stations").json()["stations"]
    assert [station["id"] for station in stations] == ["bs1", "bs2", "bs3", "bs4"]
    for station in stations:
        part = table.parts[station["id"]]
        assert tuple(station["position"].values()) == part.station.position
        assert list(station["orientation"]) == ["bearing_deg", "downtilt_deg", "slant_deg"]
        assert station["field_of_view_deg"] == pytest.approx(math.degrees(part.station.field_of_view))
        assert [level["num_cells"] for level in station["levels"]] == [level.num_cells for level in part.levels]
        windows = [level["window_deg"] for level in station["levels"]]
        assert windows == sorted(windows)
        assert windows == pytest.approx([math.degrees(level.window) for level in part.levels])


# --- refusals --------------------------------------------------------------------------------------------

REFUSED: dict[str, tuple[Any, int, str, list[str]]] = {
    # name: document or bytes, status, path, what the detail must say
    "unknown station": (changed(0, station_id="bs9"), 422, "measurements[0].station_id", ["bs9", "bs1"]),
    "unknown reference": (
        {"measurements": [TDOA | {"reference_station_id": "nowhere"}]},
        422,
        "measurements[0].reference_station_id",
        ["nowhere", "bs1"],
    ),
    "NaN": (
        json.dumps(changed(0, azimuth_deg=math.nan)).encode(),
        422,
        "measurements[0].azimuth_deg",
        ["NaN", "-180 to 360"],
    ),
    "infinity": (
        json.dumps(changed(1, range_m=-math.inf)).encode(),
        422,
        "measurements[1].range_m",
        ["infinite", "in metres"],
    ),
    "1e400": (
        json.dumps(changed(1, range_m=0)).replace('"range_m": 0', '"range_m": 1e400').encode(),
        422,
        "measurements[1].range_m",
        ["infinite", "in metres"],
    ),
    "large integer": (changed(1, range_m=10**400), 422, "measurements[1].range_m", ["digits", "in metres"]),
    "negative deviation": (changed(1, stdev_m=-0.5), 422, "measurements[1].stdev_m", ["-0.5", "positive"]),
    "no measurement": ({"measurements": []}, 422, "measurements", ["length 0", "1 to 256"]),
    "azimuth 720": (
        changed(0, azimuth_deg=720),
        422,
        "measurements[0].azimuth_deg",
        ["720", "-180 to 360", "360 off"],
    ),
    "empty body": (b"", 400, "", ["empty", '{"measurements": [...]}']),
    "truncated JSON": (json.dumps(REPORT).encode()[:-20], 400, "", ["line 1 column", "complete"]),
    "array": ([REPORT], 422, "", ["array", "give a JSON object"]),
    "wrong type": (
        changed(0, azimuth_deg="41.2"),
        422,
        "measurements[0].azimuth_deg",
        ["'41.2'", "in degrees"],
    ),
    "unknown key": (
        changed(0, rssi_dbm=-60),
        422,
        "measurements[0].rssi_dbm",
        ["unknown key", "leave it out"],
    ),
    "misspelt key": (
        changed(0, "zenith_deg", "zenith_stdev_deg", zenit_deg=90),
        422,
        "measurements[0].zenit_deg",
        ["did you mean zenith_deg?"],
    ),
    "unknown type": (changed(0, type="csi"), 422, "measurements[0].type", ["'csi'", "aoa, pt, toa, tdoa, rssi"]),
    "zenith without stdev": (
        changed(0, "zenith_stdev_deg"),
        422,
        "measurements[0].zenith_stdev_deg",
        ["missing", "both or neither"],
    ),
    "empty station": (changed(0, station_id=""), 422, "measurements[0].station_id", ["''", "1 to 128"]),
    "tdoa with itself": (
        {"measurements": [TDOA | {"station_id": "bs1"}]},
        422,
        "measurements[0].reference_station_id",
        ["'bs1'", "the station itself", "name the other"],
    ),
    "not UTF-8": (b'{"target_id": "\xff"}', 400, "", ["not JSON", "UTF-8"]),
    "deep nesting": (b"[" * 100_000, 400, "", ["not JSON", "recursion"]),
}


@pytest.mark.parametrize(("body", "status", "path", "words"), [*REFUSED.values()], ids=[*REFUSED])
def test_refusals_name_the_culprit_and_the_remedy(client: Client, body: Any, status: int, path: str, words: list[str]):
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    document = problem(client.post_bytes("/v1/positions", content), status)
    assert document["errors"][0]["path"] == path
    for word in words:
        assert word in document["detail"]
        assert word in document["errors"][0]["message"]
    # The same report within a batch gets the same problem, unless the batch itself is then no JSON.
    if status == 422 and b"1e400" not in content:
        batch = b'{"reports": [' + content + b"]}"
        assert client.post_bytes("/v1/positions/batch", batch).json() == {"results": [document]}


def test_all_problems_of_a_report_are_listed(client: Client):
    report = changed(0, azimuth_deg=720, frame="body")
    document = problem(client.post("/v1/positions", report), 422)
    assert [error["path"] for error in document["errors"]] == [
        "measurements[0].azimuth_deg",
        "measurements[0].frame",
    ]
    assert document["detail"].endswith("(and 1 more)")


@pytest.mark.parametrize(
    ("body", "status", "path", "words"),
    [
        (b"", 400, "", ["empty"]),
        (b'{"reports": [', 400, "", ["complete"]),
        (b"[]", 422, "", ['{"reports": [...]}']),
        (b"{}", 422, "reports", ["missing", "array of reports"]),
        (b'{"reports": {}}', 422, "reports", ["no array"]),
        (b'{"reports": [], "report": 1}', 422, "report", ["unknown key", "reports"]),
        (json.dumps({"reports": [0] * 1001}).encode(), 422, "reports", ["length 1001", "at most 1000"]),
    ],
)
def test_what_is_no_batch_is_refused(client: Client, body: bytes, status: int, path: str, words: list[str]):
    document = problem(client.post_bytes("/v1/positions/batch", body), status)
    assert document["errors"][0]["path"] == path
    for word in words:
        assert word in document["detail"]


@pytest.mark.parametrize("path", ["/v1/positions", "/v1/positions/batch"])
@pytest.mark.parametrize(
    "headers", [{}, {"content-type": "application/x-www-form-urlencoded"}, {"content-type": "text/json"}]
)
def test_other_content_types_are_refused(client: Client, path: str, headers: dict[str, str]):
    document = problem(client.post_bytes(path, json.dumps(REPORT).encode(), headers), 415)
    assert headers.get("content-type", "missing") in document["detail"]
    assert "Content-Type: application/json" in document["detail"]


@pytest.mark.parametrize("path", ["/v1/position", "/v1/positions/", "/v1/%ff%0A"])
def test_an_unknown_path_is_a_problem(client: Client, path: str):
    assert "/docs" in problem(client.get(path), 404)["detail"]


def test_a_wrong_method_is_a_problem(client: Client):
    response = client.get("/v1/positions")
    assert "use POST" in problem(response, 405)["detail"]
    assert response.headers["allow"] == "POST"
    assert "use GET" in problem(client.post("/v1/table", {}), 405)["detail"]


@pytest.mark.parametrize(("path", "limit"), [("/v1/positions", 1 << 20), ("/v1/positions/batch", 16 << 20)])
def test_a_body_that_is_too_large_is_refused(client: Client, path: str, limit: int):
    document = problem(client.post_bytes(path, b" " * (limit + 1)), 413)
    assert str(limit) in document["detail"]
    assert "send fewer" in document["detail"]


def test_a_body_that_does_not_say_how_large_it_is_ends_at_the_limit(client: Client):
    sent = 0

    async def chunks() -> AsyncIterator[bytes]:
        nonlocal sent
        while sent < 100 << 20:
            sent += 1 << 16
            yield b" " * (1 << 16)

    problem(client.post_bytes("/v1/positions", chunks()), 413)
    assert sent < 3 << 20


def test_limits_are_inclusive(hall_table_path: Path):
    body = json.dumps(REPORT).encode()
    limits = BodyLimits(report=len(body), batch=len(body))
    with Client(create_app(hall_table_path, ServiceSettings(body_limits=limits))) as client:
        client.wait_until_ready()
        assert client.post_bytes("/v1/positions", body).status_code == 200
        problem(client.post_bytes("/v1/positions", body + b" "), 413)
        problem(client.post_bytes("/v1/positions/batch", body + b" "), 413)


def test_a_defect_says_nothing_of_its_cause(
    client: Client, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def fail(self: Locator, report: object) -> None:
        raise RuntimeError("secret of /etc/secret")

    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(Locator, "locate", fail)
        response = client.post("/v1/positions", REPORT)
        batch = client.post("/v1/positions/batch", {"reports": [REPORT, {}]})
    assert "log" in problem(response, 500)["detail"]
    assert batch.status_code == 200
    assert [result["status"] for result in batch.json()["results"]] == [500, 422]
    for answer in (response, batch):
        assert "secret" not in answer.text
        assert "Traceback" not in answer.text
    assert caplog.text.count("RuntimeError: secret of /etc/secret") == 2


# --- readiness -------------------------------------------------------------------------------------------


def test_alive_at_once_and_ready_later(hall_table_path: Path, monkeypatch: pytest.MonkeyPatch):
    gate = threading.Event()
    warm_up = Locator.warm_up

    def wait_and_warm_up(self: Locator) -> None:
        gate.wait(60)
        warm_up(self)

    monkeypatch.setattr(Locator, "warm_up", wait_and_warm_up)
    with Client(create_app(hall_table_path)) as client:
        try:
            assert client.get("/livez").json() == {"status": "alive"}
            for method, path in [
                ("GET", "/readyz"),
                ("GET", "/v1/table"),
                ("GET", "/v1/stations"),
                ("POST", "/v1/positions"),
                ("POST", "/v1/positions/batch"),
            ]:
                response = client.request(method, path)
                assert "/readyz" in problem(response, 503)["detail"]
                assert response.headers["retry-after"] == "1"
        finally:
            gate.set()
        client.wait_until_ready()
        ready = client.get("/readyz").json()
        table_id = client.get("/v1/table").json()["table_id"]
        assert ready == {"status": "ready", "tables": [{"name": "hall", "table_id": table_id}]}


@pytest.fixture
def damaged_table_path(hall_table_copy: Path) -> Path:
    """Return a table that opens, with one bit of one number wrong."""
    with h5py.File(hall_table_copy, "r") as file:
        offset = file["scene/vertices_m"].id.get_offset()
    content = bytearray(hall_table_copy.read_bytes())
    content[offset] ^= 1
    hall_table_copy.write_bytes(content)
    return hall_table_copy


def test_a_damaged_table_is_not_served(damaged_table_path: Path):
    with pytest.raises(TableError, match=r"copy\.h5 is damaged: the checksum of scene/vertices_m.*build it again"):
        serve(damaged_table_path)


def test_a_damaged_table_is_never_ready(damaged_table_path: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.ERROR), Client(create_app(damaged_table_path)) as client:
        deadline = time.monotonic() + 30
        while "does not pass" not in client.get("/readyz").text:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        for path in ("/readyz", "/v1/table"):
            response = client.get(path)
            document = problem(response, 503)
            assert "replace it" in document["detail"]
            assert "copy.h5" not in document["detail"]
            assert "retry-after" not in response.headers
        assert client.get("/livez").status_code == 200
    assert "copy.h5" in caplog.text


# --- the OpenAPI document --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def openapi(client: Client) -> dict[str, Any]:
    return client.get("/openapi.json").json()


def test_every_example_of_the_openapi_document_works(client: Client, openapi: dict[str, Any]):
    tried = 0
    for path, operations in openapi["paths"].items():
        if not path.startswith("/v1/positions"):
            continue  # test_web.py has the viewer's
        content = operations.get("post", {}).get("requestBody", {}).get("content", {})
        ((media_type, body),) = content.items() or ((None, {}),)
        for example in body.get("examples", {}).values():
            value = example["value"]
            data = value if isinstance(value, str) else json.dumps(value)
            response = client.post_bytes(path, data, {"content-type": str(media_type)})
            assert response.status_code == 200, response.text
            for fix in response.json().get("results", [response.json()]):
                assert fix["position"] is not None
                assert fix["status"] in ("ok", "ambiguous")
                assert all(measurement["used"] for measurement in fix["measurements"])
            tried += 1
    examples = (REPORT_EXAMPLES, BATCH_EXAMPLES, NRPPA_EXAMPLES, SILABS_EXAMPLES, UBLOX_EXAMPLES)
    assert tried == sum(len(group) for group in examples)


def test_every_reference_of_the_openapi_document_leads_somewhere(openapi: dict[str, Any]):
    schemas = openapi["components"]["schemas"]
    references = set(re.findall(r'"\$ref": "([^"]*)"', json.dumps(openapi)))
    assert references
    for reference in references:
        assert reference.removeprefix("#/components/schemas/") in schemas
    for name in ("ReportDocument", "BatchDocument", "AngleDocument", "FixDocument", "Problem"):
        assert f"#/components/schemas/{name}" in references


def test_every_error_of_the_openapi_document_is_a_problem(openapi: dict[str, Any]):
    assert "HTTPValidationError" not in json.dumps(openapi)
    statuses: dict[str, set[str]] = {}
    for path, operations in openapi["paths"].items():
        for operation in operations.values():
            statuses[path] = set(operation["responses"])
            for status, response in operation["responses"].items():
                if status != "200":
                    schema = response["content"]["application/problem+json"]["schema"]
                    assert schema == {"$ref": "#/components/schemas/Problem"}
                    assert list(response["content"]) == ["application/problem+json"]
    position = {"200", "400", "401", "404", "413", "415", "422", "429", "503", "504"}
    assert statuses == {
        "/v1/positions": position,
        "/v1/positions/batch": position,
        "/v1/positions/nrppa": position,
        "/v1/positions/silabs": position,
        "/v1/positions/ublox": position - {"400"},
        "/v1/fixes": {"200", "401", "404", "422", "503"},
        "/v1/table": {"200", "401", "404", "422", "503"},
        "/v1/tables": {"200", "401", "503"},
        "/v1/tables/reload": {"200", "401", "409", "429"},
        "/v1/stations": {"200", "401", "404", "422", "503"},
        "/v1/viewer": {"200", "401", "404", "422", "503"},
        "/v1/scene.glb": {"200", "401", "404", "422", "503"},
        "/v1/stations/{station_id}/mixture": {"200", "401", "404", "422", "503"},
        "/v1/stations/{station_id}/coverage": {"200", "401", "404", "422", "503"},
        "/v1/simulations": position | {"403"},
        "/v1/posteriors": position,
        "/livez": {"200"},
        "/readyz": {"200", "503"},
        "/metrics": {"200", "401"},
    }


def test_the_example_of_a_problem_is_what_comes(client: Client):
    response = client.post("/v1/positions", changed(0, azimuth_stdev_deg=-1))
    assert response.json() == PROBLEM_EXAMPLE


def test_the_docs_are_there(client: Client):
    response = client.get("/docs")
    assert response.status_code == 200
    assert "/openapi.json" in response.text
