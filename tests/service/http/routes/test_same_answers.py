"""The fast path and the router give the same answers, and the same refusals."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from rayfix_service.http.openapi.examples import REPORT_EXAMPLES
from rayfix_service.http.settings import BodyLimits
from tests.support.messages.measurements import TDOA
from tests.support.messages.reports import REPORT, changed
from tests.support.running.running_app import JSON, RunningApp

JSON_BODIES: dict[str, Any] = {
    **{name: example["value"] for name, example in REPORT_EXAMPLES.items()},
    "unknown station": changed(0, station_id="bs9"),
    "unknown reference": {"measurements": [TDOA | {"reference_station_id": "nowhere"}]},
    "angle out of range": changed(0, azimuth_deg=720),
    "negative deviation": changed(1, stdev_m=-0.5),
    "text for a number": changed(0, azimuth_deg="41.2"),
    "no measurement": {"measurements": []},
    "unknown key": REPORT | {"colour": "blue"},
    "an array": [REPORT],
    "a report of ten wrong measurements": {"measurements": [{"type": "aoa"}] * 10},
}
BODIES: dict[str, bytes] = {
    **{name: json.dumps(document).encode() for name, document in JSON_BODIES.items()},
    "NaN": json.dumps(changed(0, azimuth_deg=math.nan)).encode(),
    "nothing": b"",
    "half a document": json.dumps(REPORT).encode()[:-20],
    "no UTF-8": b'{"target_id": "\xff"}',
    "too long": b" " * 70_000,
}
HEADERS: dict[str, dict[str, str]] = {
    "json": JSON,
    "json with a charset": {"content-type": "application/json; charset=utf-8"},
    "omlox wanted": {**JSON, "accept": "application/vnd.rayfix.omlox+json"},
    "no type": {},
    "another type": {"content-type": "text/plain"},
}


@pytest.fixture(scope="module")
def service(hall_table_path: Path) -> Iterator[RunningApp]:
    with RunningApp(hall_table_path, body_limits=BodyLimits(report=65_536)) as running:
        yield running


def told(answer: httpx.Response) -> tuple[int, dict[str, str], Any]:
    """Return what an answer says, without the time that it took."""
    headers = {name: value for name, value in answer.headers.items() if name not in ("x-request-id", "content-length")}
    document = answer.json()
    if isinstance(document, dict):
        document.pop("compute_ms", None)
        document.pop("instance", None)
    return answer.status_code, headers, document


@pytest.mark.parametrize("name", BODIES)
def test_any_body_gets_the_same_answer_either_way(service: RunningApp, name: str) -> None:
    fast = service.post_bytes("/v1/positions", BODIES[name])
    routed = service.post_bytes("/v1/positions?table=hall", BODIES[name])
    assert told(fast) == told(routed)
    assert (fast.status_code == 200) == (name in REPORT_EXAMPLES)


@pytest.mark.parametrize("name", HEADERS)
def test_any_headers_get_the_same_answer_either_way(service: RunningApp, name: str) -> None:
    fast = service.post_bytes("/v1/positions", BODIES["angle_and_time"], HEADERS[name])
    routed = service.post_bytes("/v1/positions?table=hall", BODIES["angle_and_time"], HEADERS[name])
    assert told(fast) == told(routed)
    assert (fast.status_code == 415) == (name in ("no type", "another type"))
