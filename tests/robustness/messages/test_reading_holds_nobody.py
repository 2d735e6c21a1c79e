"""While one client's message is read, however long, the service answers others."""

import asyncio
import gc
import json
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import httpx
import pytest

from rayfix_service.http.openapi.examples import BATCH_EXAMPLES
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits
from tests.support.running.running_app import JSON, RunningApp

TEXT = {"content-type": "text/plain"}

LINES = "".join(f'+UUDF:t{k},-53,15,-6,0,37,"a{k}","",{k},{k}\n' for k in range(20_000)).encode()
ONE_PACKET = "".join(f'+UUDF:t,-53,15,-6,0,37,"a{k}","",{k},7\n' for k in range(20_000)).encode()
UNKNOWN = b",".join(b'"k%d":1' % k for k in range(70_000))
NO_AZIMUTH = {"measuredResultsValue": {"MultipleULAoA": {"multipleULAoA": [{"ul-ZoA": {"zenithAoA": 1}}] * 8}}}
NRPPA = {"TRP-MeasurementResponseList": [{"tRP-ID": n + 1, "measurementResult": [NO_AZIMUTH] * 64} for n in range(40)]}
SHORT_UNKNOWN = b",".join(b'"k%d":1' % k for k in range(1000))
REPORTS = b",".join([b"{" + SHORT_UNKNOWN + b"}"] * 999)

MESSAGES = [
    pytest.param("/v1/positions/ublox", TEXT, LINES, id="u-blox lines, all different"),
    pytest.param("/v1/positions/ublox", TEXT, ONE_PACKET, id="u-blox lines of one packet"),
    pytest.param("/v1/positions/nrppa", JSON, json.dumps(NRPPA).encode(), id="NRPPa angles that no fix can use"),
    pytest.param("/v1/positions/nrppa", JSON, b"{" + UNKNOWN + b"}", id="NRPPa of unknown keys"),
    pytest.param("/v1/positions/silabs", JSON, b'{"angles":[' + b"{}," * 300_000 + b"{}]}", id="empty angles"),
    pytest.param("/v1/positions", JSON, b"{" + UNKNOWN + b"}", id="a report of unknown keys"),
    pytest.param("/v1/positions/batch", JSON, b'{"reports":[' + REPORTS + b"]}", id="a batch of unknown keys"),
    pytest.param("/v1/positions/batch", JSON, b'{"reports":[' + b"[" * 15_000_000, id="a batch of brackets"),
    pytest.param("/v1/positions/batch", JSON, b'{"reports":[' + b"[]," * 5_000_000 + b"1]}", id="a batch of arrays"),
]


@pytest.fixture(scope="module")
def app(hall_table_path: Path) -> Iterator[RunningApp]:
    with RunningApp(hall_table_path) as app:
        gc.collect()
        gc.freeze()  # as the service does
        yield app
        gc.unfreeze()


async def longest_wait(stop: asyncio.Event) -> float:
    """Measure how long the event loop let others wait at most, s, until told to stop."""
    longest, last = 0.0, perf_counter()
    while not stop.is_set():
        await asyncio.sleep(0.001)
        now = perf_counter()
        longest, last = max(longest, now - last), now
    return longest


@pytest.mark.parametrize(("path", "headers", "body"), MESSAGES)
def test_the_event_loop_is_not_held(app: RunningApp, path: str, headers: dict[str, str], body: bytes):
    """One such message held the loop for 2 to more than 300 s, and its answer could have 30,000 errors."""

    async def scenario() -> tuple[httpx.Response, float]:
        stop = asyncio.Event()
        watch = asyncio.create_task(longest_wait(stop))
        answer = await app.http.post(path, content=body, headers=headers)
        stop.set()
        return answer, await watch

    for _ in range(4):  # a busy machine holds the loop as well
        answer, held = app.run(scenario())
        if held < 0.5:
            break
    assert held < 0.5
    document = answer.json()
    problems = document.get("results", [document])
    listed = [len(problem["errors"]) for problem in problems]
    assert 0 < listed[0] <= USUAL_LIMITS.listed_problems
    assert sum(listed) < 2 * USUAL_LIMITS.listed_problems + len(listed)
    assert len(answer.content) < 1000 * (len(listed) + USUAL_LIMITS.listed_problems)


def test_a_batch_lists_errors_up_to_a_limit_and_counts_the_others(app: RunningApp):
    wrong = {"measurements": [{"type": "pt"}] * 15}  # each lacks its station and a length
    response = app.post("/v1/positions/batch", {"reports": [wrong] * 8})
    assert response.status_code == 200
    problems = response.json()["results"]
    totals = {len(problem["errors"]) + problem.get("more_errors", 0) for problem in problems}
    assert len(totals) == 1
    assert [len(problem["errors"]) for problem in problems][-2:] == [1, 1]
    assert problems[-1]["more_errors"] == totals.pop() - 1
    assert "more_errors" not in problems[0]


def test_a_bad_report_leaves_the_others_of_its_batch_alone_and_bad_json_does_not(app: RunningApp):
    reports: list[Any] = BATCH_EXAMPLES["two_reports"]["value"]["reports"]
    results = app.post("/v1/positions/batch", {"reports": [reports[0], {"mesurements": []}, 5]}).json()["results"]
    assert results[0]["status"] == "ok"
    assert [problem["status"] for problem in results[1:]] == [422, 422]
    one = json.dumps(reports[0]).encode()
    answer = app.post_bytes("/v1/positions/batch", b'{"reports":[' + one + b',{"a":}]}')
    assert answer.status_code == 400
    assert answer.json()["detail"].startswith("reports[1]: the document is not JSON")
    assert app.post_bytes("/v1/positions/batch", b'{"reports":[' + one + b",]}").status_code == 400


def test_limits_of_messages_are_settings(hall_table_path: Path):
    limits = MessageLimits(
        report_values=400, message_values=300, results=4, stations=3, batch_rest_bytes=2000, listed_problems=2
    )
    refusals: list[tuple[str, Any, str]] = [
        ("", {"measurements": [{"k": n} for n in range(300)]}, "more than 400 values"),
        ("/silabs", {"angles": [{"locator_id": "a", "x": list(range(400))}]}, "more than 300 values"),
        ("/silabs", {"stations": dict.fromkeys("abcd", "bs1")}, "give at most 3"),
        ("/nrppa", {"TRP-MeasurementResponseList": [{"tRP-ID": 1, "measurementResult": [{}] * 5}]}, "more than 4 m"),
        ("/batch", {"reports": [], "x": "y" * 3000}, "bytes after its reports"),
    ]
    with RunningApp(hall_table_path, message_limits=limits) as app:
        for path, document, words in refusals:
            answer = app.post(f"/v1/positions{path}", document)
            assert answer.status_code == 422
            assert words in answer.json()["detail"], answer.text
        wrong = {"measurements": [{"type": "pt"}] * 4}
        (one,) = {
            app.post(path, wrong).text for path in ("/v1/positions", "/v1/positions?table=hall", "/v1/posteriors")
        }
        assert len(json.loads(one)["errors"]) == 2
        assert json.loads(one)["more_errors"] > 0
        listed = [
            len(problem["errors"])
            for problem in app.post("/v1/positions/batch", {"reports": [wrong] * 3}).json()["results"]
        ]
        assert listed == [2, 1, 1]
