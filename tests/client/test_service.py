"""Both clients against the real service."""

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

import rayfix
from rayfix.client import FixAnswer, FixEvent, ProblemError, RefusedReportError
from rayfix.errors import ClientError
from rayfix.example.files import example_report
from rayfix_service.http.openapi.examples import NRPPA_EXAMPLES, SILABS_EXAMPLES, UBLOX_EXAMPLES
from rayfix_service.wire import parse_report
from rayfix_tables.errors import ReportError


@pytest.fixture
def report() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(example_report())
    return document


def test_a_fix_has_what_the_service_answers(service_url: str, report: dict[str, Any]):
    with rayfix.Client(service_url) as client:
        assert client.ready()
        fix = client.locate(report)
        again = client.locate(parse_report(report))
        raw = client.locate_as(report, "native")
        omlox = client.locate_as(report, "omlox")
    assert fix.status == "ok"
    assert fix.target_id == report["target_id"]
    assert fix.position is not None
    assert [fix.position.x, fix.position.y, fix.position.z] == list(raw["position"].values())
    assert [list(row) for row in fix.covariance_m2 or ()] == raw["covariance_m2"]
    assert [one.index for one in fix.measurements] == list(range(len(report["measurements"])))
    assert all(one.used and one.reason is None for one in fix.measurements)
    assert fix.candidates[0].position == fix.position
    assert again.position is not None
    assert again.position.x == pytest.approx(fix.position.x, abs=1e-6)
    assert omlox["provider_id"] == report["target_id"]


def test_degrees_are_not_taken_for_radians(service_url: str):
    """An azimuth of 70 rad went out as 4010.7 degrees, and came back as a fix."""
    angle = rayfix.Angle(station_id="bs1", azimuth=70.0, azimuth_stdev=0.02)
    wrong = rayfix.Report(measurements=(angle,))
    right = rayfix.Report(measurements=(rayfix.Range(station_id="bs1", path_length=7.0, stdev=1.0),))
    with rayfix.Client(service_url) as client:
        with pytest.raises(ReportError, match=r"azimuth is 70\.0; .*, in radians"):
            client.locate(wrong)
        with pytest.raises(ReportError, match=r"reports\[1\]: .*azimuth") as found:
            client.locate_batch([right, wrong])
    assert found.value.path == ("reports", 1, "measurements", 0, "azimuth")


def test_a_target_is_followed(service_url: str, report: dict[str, Any]):
    with rayfix.Client(service_url, track=True) as client:
        fixes = [client.locate({**report, "timestamp": f"2026-01-31T10:00:00.{n}Z"}) for n in range(3)]
        (batch,) = client.locate_batch([{**report, "timestamp": "2026-01-31T10:00:00.4Z"}])
        (streamed,) = client.stream([{**report, "timestamp": "2026-01-31T10:00:00.6Z"}])
        assert isinstance(batch, FixAnswer)
        assert isinstance(streamed, FixAnswer)
        with pytest.raises(RefusedReportError) as found:
            client.locate({**report, "timestamp": None})
    assert found.value.path == ("timestamp",)
    tracks = [fix.track for fix in (*fixes, batch, streamed)]
    assert [track.num_reports for track in tracks if track] == [1, 2, 3, 4, 5]
    assert tracks[-1] is not None
    # Errors of stations drift: five reports within a second tell little more than one, and look like little more.
    assert tracks[-1].horizontal_accuracy_m == pytest.approx(fixes[0].horizontal_accuracy_m, rel=0.1)


def test_a_refused_report_names_the_field(service_url: str, report: dict[str, Any]):
    report["measurements"][1]["station_id"] = "nowhere"
    with rayfix.Client(service_url) as client, pytest.raises(RefusedReportError, match="nowhere") as found:
        client.locate(report)
    assert isinstance(found.value, ReportError)
    assert found.value.status == 422
    assert found.value.path == ("measurements[1].station_id",)
    assert [error.path for error in found.value.errors] == ["measurements[1].station_id"]


def test_a_batch_is_cut_and_put_together(service_url: str, report: dict[str, Any]):
    reports = [{**report, "target_id": f"t{n}"} for n in range(1003)]
    reports[1001] = {"target_id": "t1001", "measurements": []}
    with rayfix.Client(service_url) as client:
        answers = client.locate_batch(reports)
        assert client.locate_batch([]) == []
    assert len(answers) == 1003
    assert isinstance(answers[1001], RefusedReportError)
    assert answers[1001].path == ("measurements",)
    fixes = [answer for answer in answers if isinstance(answer, FixAnswer)]
    assert [fix.target_id for fix in fixes] == [f"t{n}" for n in range(1003) if n != 1001]


def test_table_and_stations(service_url: str):
    with rayfix.Client(service_url) as client:
        stations, table = client.stations(), client.table()
        assert client.tables() == (table,)
    assert [station.id for station in stations] == ["bs1", "bs2", "bs3", "bs4"]
    assert (stations[0].position.x, stations[0].bearing_deg) == (0.1, 45.0)
    assert table.name == "hall"
    assert (table.site_name, table.num_stations, len(table.table_id)) == ("hall", 4, 64)


def test_the_feed_tells_of_others_fixes(service_url: str, report: dict[str, Any]):
    heard: list[FixEvent] = []
    ended = threading.Event()

    def listen() -> None:
        with rayfix.Client(service_url) as client:
            for event in client.fixes(target_id="heard"):
                heard.append(event)
                break
        ended.set()

    threading.Thread(target=listen, daemon=True).start()
    with rayfix.Client(service_url) as client:
        deadline = time.monotonic() + 20
        while not ended.wait(0.05):
            assert time.monotonic() < deadline
            client.locate({**report, "target_id": "other"})
            fix = client.locate({**report, "target_id": "heard"})
    assert heard[0].fix.position == fix.position
    assert heard[0].report["target_id"] == heard[0].fix.target_id == "heard"
    assert heard[0].table == "hall"


def test_a_stream_answers_each_report(service_url: str, report: dict[str, Any]):
    reports = [report, {"measurements": []}, {**report, "target_id": "t2"}]
    with rayfix.Client(service_url) as client:
        answers = list(client.stream(reports))
    assert [type(answer) for answer in answers] == [FixAnswer, RefusedReportError, FixAnswer]
    assert isinstance(answers[2], FixAnswer)
    assert answers[2].target_id == "t2"


def test_the_client_for_asyncio_does_the_same(service_url: str, report: dict[str, Any]):
    async def some() -> AsyncIterator[dict[str, Any]]:
        for n in range(3):
            yield {**report, "target_id": f"s{n}"}

    async def scenario() -> None:
        async with rayfix.AsyncClient(service_url) as client:
            assert await client.ready()
            with rayfix.Client(service_url) as other:
                expected = other.locate(report)
            assert (await client.locate(report)).position == expected.position
            assert (await client.locate_as(report, "3gpp"))["shape"] == "LOCAL_3D_POINT_UNCERTAINTY_ELLIPSOID"
            assert [station.id for station in await client.stations()] == ["bs1", "bs2", "bs3", "bs4"]
            assert (await client.table()).site_name == "hall"
            assert await client.tables() == (await client.table(),)
            answers = await client.locate_batch([report, {"measurements": []}])
            assert isinstance(answers[0], FixAnswer)
            assert isinstance(answers[1], ProblemError)
            streamed = [answer async for answer in client.stream(some())]
            assert [answer.target_id for answer in streamed if isinstance(answer, FixAnswer)] == ["s0", "s1", "s2"]
            first = asyncio.create_task(anext(client.fixes()))
            async with asyncio.timeout(20):
                while not first.done():
                    await client.locate(report)
                    await asyncio.sleep(0.05)
            assert first.result().fix.position == expected.position

    asyncio.run(scenario())


def test_messages_of_other_systems_are_located(service_url: str):
    message = SILABS_EXAMPLES["three_locators"]["value"]
    lines = UBLOX_EXAMPLES["three_anchors"]["value"].replace('"bs1"', '"door"')
    with rayfix.Client(service_url) as client:
        fix = client.locate_message(message, "silabs")
        batch = client.locate_messages([message, {}], "silabs")
        nrppa = client.locate_message(NRPPA_EXAMPLES["ul_aoa_and_ul_rtoa"]["value"], "nrppa")
        (line,) = client.locate_lines(lines, stations={"door": "bs1"}, height=(1.5, 0.1), confidence=0.9)
        (wrong,) = client.locate_lines(lines)
        with pytest.raises(ClientError, match="locate_lines"):
            client.locate_message(message, "ublox")
    assert isinstance(batch[0], FixAnswer)
    assert batch[0].position == fix.position
    assert [outcome.source for outcome in fix.measurements] == ["angles[0]", "angles[1]", "angles[2]"]
    assert isinstance(batch[1], RefusedReportError)
    assert (nrppa.target_id, nrppa.skipped) == ("ue-7", ())
    assert isinstance(line, FixAnswer)
    assert line.position is not None
    assert line.position.z == pytest.approx(1.5, abs=0.2)
    assert line.confidence == pytest.approx(0.9, abs=0.02)
    assert isinstance(wrong, RefusedReportError)
