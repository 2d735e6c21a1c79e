"""Targets followed over HTTP, the format by Accept header, and an omlox hub that is told."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from rayfix.client.models import fix_answer
from rayfix_service.adapters.omlox_hub import HubSettings
from rayfix_service.http.answering.response_options import response_options_of
from rayfix_service.http.openapi.examples import SILABS_EXAMPLES
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.server.app import create_app
from rayfix_service.wire import FixDocument
from tests.support.messages.reports import REPORT
from tests.support.running.running_app import serving, until_ready

SETTINGS = ServiceSettings()


def at(second: float, **more: Any) -> dict[str, Any]:
    return {**REPORT, "target_id": "agv-7", "timestamp": f"2026-01-31T10:00:{second:06.3f}Z", **more}


@asynccontextmanager
async def service(table_path: Path, settings: ServiceSettings = SETTINGS) -> AsyncIterator[httpx.AsyncClient]:
    """Run the application, ready to locate."""
    async with serving(create_app(table_path, settings)) as http:
        await until_ready(http)
        yield http


def run(scenario: Callable[[], Awaitable[None]]) -> None:
    async def main() -> None:
        await scenario()

    asyncio.run(main())


def test_targets_are_followed_where_a_request_says_so(hall_table_path: Path):
    async def scenario() -> None:
        async with service(hall_table_path) as http:
            states, alone = [], []
            for n in range(4):
                answer = (await http.post("/v1/positions?track=true", json=at(0.2 * n))).json()
                FixDocument.model_validate(answer)
                assert fix_answer(answer).track is not None
                states.append((answer["track"]["state"], answer["track"]["num_reports"], answer["track"]["timestamp"]))
                alone.append((await http.post("/v1/positions", json=at(0.2 * n))).json())
                # The fix itself is what it is without.
                assert answer["position"] == alone[-1]["position"]
            assert states == [
                ("started" if n == 0 else "updated", n + 1, f"2026-01-31T10:00:00.{2 * n}00Z") for n in range(4)
            ]
            assert all("track" not in answer for answer in alone)
            late = (await http.post("/v1/positions?track=true", json=at(0.2))).json()["track"]
            assert (late["state"], late["timestamp"]) == ("late", "2026-01-31T10:00:00.600Z")
            batch = {"reports": [at(0.8), at(0.8, target_id="other"), at(1.0), {**REPORT, "timestamp": None}]}
            results = (await http.post("/v1/positions/batch?track=true", json=batch)).json()["results"]
            assert [r["track"]["num_reports"] for r in results[:3]] == [5, 1, 6]
            assert results[3]["errors"][0]["path"] == "timestamp"
            silabs = {**SILABS_EXAMPLES["three_locators"]["value"], "timestamp": "2026-01-31T10:00:00Z"}
            track = (await http.post("/v1/positions/silabs?track=true", json=silabs)).json()["track"]
            assert track["state"] == "started"
            metrics = (await http.get("/metrics")).text
            assert 'rayfix_tracks_total{state="updated"} 5.0' in metrics
            assert 'rayfix_tracks_total{state="late"} 1.0' in metrics

    run(scenario)


@pytest.mark.parametrize("missing", ["target_id", "timestamp"])
def test_what_cannot_be_followed_is_refused_only_if_asked_for(hall_table_path: Path, missing: str):
    async def scenario() -> None:
        async with service(hall_table_path, replace(SETTINGS, track=True)) as http:
            report = {key: value for key, value in at(0.0).items() if key != missing}
            asked = await http.post("/v1/positions?track=true", json=report)
            assert asked.status_code == 422
            assert [error["path"] for error in asked.json()["errors"]] == [missing]
            assert "track" not in (await http.post("/v1/positions", json=report)).json()
            # The setting holds on the short way, too, and a request may say otherwise.
            assert (await http.post("/v1/positions", json=at(1.0))).json()["track"]["state"] == "started"
            assert "track" not in (await http.post("/v1/positions?track=false", json=at(2.0))).json()

    run(scenario)


def test_the_accept_header_chooses_the_format(hall_table_path: Path):
    async def scenario() -> None:
        async with service(hall_table_path) as http:
            answer = await http.post(
                "/v1/positions", json=at(0.0), headers={"accept": "application/vnd.rayfix.omlox+json, */*;q=0.1"}
            )
            assert answer.headers["content-type"] == "application/vnd.rayfix.omlox+json"
            assert answer.json()["crs"] == "local"
            tracked = await http.post(
                "/v1/positions?track=true", json=at(0.0), headers={"accept": "application/vnd.rayfix.omlox+json"}
            )
            assert {"speed", "course"} <= tracked.json().keys()
            # The query has the last word.
            both = await http.post(
                "/v1/positions?output=3gpp", json=at(0.0), headers={"accept": "application/vnd.rayfix.omlox+json"}
            )
            assert both.json()["shape"] == "LOCAL_3D_POINT_UNCERTAINTY_ELLIPSOID"
            assert both.headers["content-type"] == "application/json"
            assert "status" in (await http.post("/v1/positions", json=at(0.0), headers={"accept": "text/html"})).json()

    run(scenario)


@pytest.mark.parametrize(
    ("accept", "output", "media_type"),
    [
        (None, "native", "application/json"),
        ("*/*", "native", "application/json"),
        ("text/html, */*;q=0.8", "native", "application/json"),
        ("application/vnd.rayfix+json", "native", "application/vnd.rayfix+json"),
        ("Application/VND.rayfix.3gpp+JSON; charset=utf-8", "3gpp", "application/vnd.rayfix.3gpp+json"),
        ("application/json, application/vnd.rayfix.3gpp+json", "native", "application/json"),
        ("application/json;q=0.2, application/vnd.rayfix.3gpp+json;q=0.3", "3gpp", "application/vnd.rayfix.3gpp+json"),
        ("application/vnd.rayfix.3gpp+json;q=0, application/vnd.rayfix.omlox+json;q=0.1", "omlox", None),
        ("application/vnd.rayfix.3gpp+json;q=nan", "native", "application/json"),
        ("application/vnd.rayfix.3gpp+json;q=9", "native", "application/json"),
        ("application/vnd.rayfix.pdf+json", "native", "application/json"),
        (",;,q=;rayfix", "native", "application/json"),
    ],
)
def test_accept_headers(accept: str | None, output: str, media_type: str | None):
    headers = [] if accept is None else [(b"accept", accept.encode())]
    wanted = response_options_of({"type": "http", "headers": headers}, SETTINGS)
    assert wanted.output == output
    assert wanted.media_type == (media_type or f"application/vnd.rayfix.{output}+json")
    assert not wanted.track


def test_a_hub_is_told_and_costs_nothing_when_it_is_gone(hall_table_path: Path):
    told: list[dict[str, Any]] = []

    async def hub(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
        (length,) = (int(line.split(":")[1]) for line in head.splitlines() if line.startswith("content-length"))
        told.append(json.loads(await reader.readexactly(length)))
        writer.write(b"HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n")
        await writer.drain()
        writer.close()

    async def scenario() -> None:
        async with await asyncio.start_server(hub, "127.0.0.1", 0) as server:
            url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v2"
            async with service(hall_table_path, replace(SETTINGS, hub=HubSettings(url=url))) as http:
                fix = (await http.post("/v1/positions", json=at(0.0))).json()
                track = (await http.post("/v1/positions?track=true", json=at(0.0))).json()["track"]
                nowhere = {"measurements": [{"type": "pt", "station_id": "bs1", "range_m": -500, "stdev_m": 0.1}]}
                assert (await http.post("/v1/positions", json=nowhere)).json()["position"] is None
                async with asyncio.timeout(20):
                    while 'rayfix_omlox_locations_total{outcome="sent"} 2.0' not in (await http.get("/metrics")).text:
                        await asyncio.sleep(0.02)
            assert [one["position"]["coordinates"] for one in told] == [
                list(fix["position"].values()),
                list(track["position"].values()),
            ]
        gone = HubSettings(url=url, attempts=1)
        async with service(hall_table_path, replace(SETTINGS, hub=gone)) as http:
            assert (await http.post("/v1/positions", json=at(0.0))).status_code == 200
            async with asyncio.timeout(20):
                while 'rayfix_omlox_locations_total{outcome="dropped"} 1.0' not in (await http.get("/metrics")).text:
                    await asyncio.sleep(0.02)

    run(scenario)
