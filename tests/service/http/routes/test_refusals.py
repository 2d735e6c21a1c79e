"""What the service refuses: each refusal is a problem document that names the culprit and the remedy."""

import json
import logging
import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from rayfix_service.http.settings import BodyLimits
from rayfix_service.locator import Locator
from tests.support.messages.measurements import TDOA
from tests.support.messages.problems import problem_of
from tests.support.messages.reports import REPORT, changed
from tests.support.running.running_app import RunningApp

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
def test_refusals_name_the_culprit_and_the_remedy(
    hall_app: RunningApp, body: Any, status: int, path: str, words: list[str]
):
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    document = problem_of(hall_app.post_bytes("/v1/positions", content), status)
    assert document["errors"][0]["path"] == path
    for word in words:
        assert word in document["detail"]
        assert word in document["errors"][0]["message"]
    # The same report within a batch gets the same problem, unless the batch itself is then no JSON.
    if status == 422 and b"1e400" not in content:
        batch = b'{"reports": [' + content + b"]}"
        assert hall_app.post_bytes("/v1/positions/batch", batch).json() == {"results": [document]}


def test_all_problems_of_a_report_are_listed(hall_app: RunningApp):
    report = changed(0, azimuth_deg=720, frame="body")
    document = problem_of(hall_app.post("/v1/positions", report), 422)
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
        (json.dumps({"reports": [0] * 1001}).encode(), 422, "reports", ["more than 1000", "at most 1000"]),
    ],
)
def test_what_is_no_batch_is_refused(hall_app: RunningApp, body: bytes, status: int, path: str, words: list[str]):
    document = problem_of(hall_app.post_bytes("/v1/positions/batch", body), status)
    assert document["errors"][0]["path"] == path
    for word in words:
        assert word in document["detail"]


@pytest.mark.parametrize("path", ["/v1/positions", "/v1/positions/batch"])
@pytest.mark.parametrize(
    "headers", [{}, {"content-type": "application/x-www-form-urlencoded"}, {"content-type": "text/json"}]
)
def test_other_content_types_are_refused(hall_app: RunningApp, path: str, headers: dict[str, str]):
    document = problem_of(hall_app.post_bytes(path, json.dumps(REPORT).encode(), headers), 415)
    assert headers.get("content-type", "missing") in document["detail"]
    assert "Content-Type: application/json" in document["detail"]


@pytest.mark.parametrize("path", ["/v1/position", "/v1/positions/", "/v1/%ff%0A"])
def test_an_unknown_path_is_a_problem(hall_app: RunningApp, path: str):
    assert "/docs" in problem_of(hall_app.get(path), 404)["detail"]


def test_a_wrong_method_is_a_problem(hall_app: RunningApp):
    response = hall_app.get("/v1/positions")
    assert "use POST" in problem_of(response, 405)["detail"]
    assert response.headers["allow"] == "POST"
    assert "use GET" in problem_of(hall_app.post("/v1/table", {}), 405)["detail"]


@pytest.mark.parametrize(("path", "limit"), [("/v1/positions", 1 << 20), ("/v1/positions/batch", 16 << 20)])
def test_a_body_that_is_too_large_is_refused(hall_app: RunningApp, path: str, limit: int):
    document = problem_of(hall_app.post_bytes(path, b" " * (limit + 1)), 413)
    assert str(limit) in document["detail"]
    assert "send fewer" in document["detail"]


def test_a_body_that_does_not_say_how_large_it_is_ends_at_the_limit(hall_app: RunningApp):
    sent = 0

    async def chunks() -> AsyncIterator[bytes]:
        nonlocal sent
        while sent < 100 << 20:
            sent += 1 << 16
            yield b" " * (1 << 16)

    problem_of(hall_app.post_bytes("/v1/positions", chunks()), 413)
    assert sent < 3 << 20


def test_limits_are_inclusive(hall_table_path: Path):
    body = json.dumps(REPORT).encode()
    limits = BodyLimits(report=len(body), batch=len(body))
    with RunningApp(hall_table_path, body_limits=limits) as app:
        assert app.post_bytes("/v1/positions", body).status_code == 200
        problem_of(app.post_bytes("/v1/positions", body + b" "), 413)
        problem_of(app.post_bytes("/v1/positions/batch", body + b" "), 413)


def test_a_defect_says_nothing_of_its_cause(
    hall_app: RunningApp, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def fail(self: Locator, report: object, **options: object) -> None:
        raise RuntimeError("secret of /etc/secret")

    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(Locator, "fuse", fail)
        response = hall_app.post("/v1/positions", REPORT)
        batch = hall_app.post("/v1/positions/batch", {"reports": [REPORT, {}]})
    assert "log" in problem_of(response, 500)["detail"]
    assert batch.status_code == 200
    assert [result["status"] for result in batch.json()["results"]] == [500, 422]
    for answer in (response, batch):
        assert "secret" not in answer.text
        assert "Traceback" not in answer.text
    assert caplog.text.count("RuntimeError: secret of /etc/secret") == 2
