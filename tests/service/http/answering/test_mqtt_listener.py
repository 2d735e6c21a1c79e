"""A service that reads an MQTT broker: its positions are in the broker, the events, the figures and the tracks."""

import asyncio
import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from rayfix.cli import main, make_parser
from rayfix.commands.broker import mqtt_source
from rayfix_service.adapters.adapted import Adapted
from rayfix_service.adapters.mqtt.session import MqttSession, angle_stream
from rayfix_service.adapters.mqtt.settings import Broker, MqttSettings, MqttSource
from rayfix_service.fusion.measurements.report import Height
from rayfix_service.http.settings import ServiceSettings
from rayfix_service.server.app import create_app
from rayfix_tables.site import SiteInfo, Station
from tests.support.messages.reports import REPORT
from tests.support.running.mqtt_broker import MESSAGE, TAG, Mosquitto, angles, broker_in, exchange
from tests.support.running.running_app import serving, until_ready
from tests.support.running.server_process import start_server

STATIONS: dict[str, str] = MESSAGE["stations"]


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    with broker_in(tmp_path) as broker:
        yield broker


async def connection_is(http: httpx.AsyncClient, state: str) -> None:
    async with asyncio.timeout(30):
        while (await http.get("/readyz")).json()["mqtt"]["connection"] != state:
            await asyncio.sleep(0.05)


def test_positions_of_the_broker_are_those_of_the_service(mosquitto: Mosquitto, hall_table_path: Path):
    address = mosquitto.address
    settings = MqttSettings(window=0.2, stations=STATIONS, track=True)
    app = create_app(hall_table_path, ServiceSettings(mqtt=MqttSource(broker=address, settings=settings)))
    stranger = ("silabs/aoa/angle/stranger/tag", b"{}")

    async def scenario() -> None:
        async with serving(app) as http:
            await until_ready(http)
            # The broker comes later than the service, which answers requests meanwhile.
            assert (await http.get("/readyz")).json()["mqtt"] == {"address": address.address, "connection": "lost"}
            assert (await http.post("/v1/positions", json=REPORT)).json()["status"] == "ok"
            mosquitto.start()
            await connection_is(http, "connected")
            with app.state.services.feed.subscribe() as subscription:
                ((topic, first),) = await exchange(address, [stranger, *angles(1)], answers=1)
                ((_, second),) = await exchange(address, angles(2), answers=1)
                _, events = subscription.take()
            assert topic == f"rayfix/position/{TAG}"
            assert [document["track"]["num_reports"] for document in (first, second)] == [1, 2]
            told = [json.loads(event.data) for event in events]
            assert [event["fix"]["track"]["num_reports"] for event in told] == [1, 2]
            assert told[0]["table"] == "hall"
            assert len(told[0]["report"]["measurements"]) == 3
            figures = (await http.get("/metrics")).text
            for line in (
                'rayfix_reports_total{outcome="answered",source="mqtt"} 2.0',
                'rayfix_report_seconds_count{source="mqtt"} 2.0',
                'rayfix_mqtt_messages_total{outcome="taken"} 6.0',
                'rayfix_mqtt_messages_total{outcome="passed_over"} 1.0',
                f'rayfix_mqtt_connected{{broker="{address.address}"}} 1.0',
                'rayfix_tracks_total{state="updated"} 1.0',
            ):
                assert f"\n{line}\n" in figures
            counted = re.findall(r'rayfix_station_measurements_total{outcome="\w+",station="bs1",\S+} (\S+)', figures)
            assert sum(map(float, counted)) == 4  # an angle of each packet; by HTTP, an angle and a time
            mosquitto.stop()
            await connection_is(http, "lost")
            assert f'rayfix_mqtt_connected{{broker="{address.address}"}} 0.0' in (await http.get("/metrics")).text
            mosquitto.start()
            await connection_is(http, "connected")
            assert len(await exchange(address, angles(3), answers=1)) == 1

    asyncio.run(scenario())


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline, "not in time"
        time.sleep(0.05)


def test_one_of_several_workers_reads_the_broker(mosquitto: Mosquitto, hall_table_path: Path):
    mosquitto.start()
    broker = {"host": mosquitto.address.host, "port": mosquitto.address.port}
    source = {"broker": broker, "settings": {"window": 0.2, "stations": STATIONS, "track": True}}

    def connections() -> set[str]:
        """State by several connections, which are of both workers."""
        with server.client() as http:
            answers = [http.get("/readyz", headers={"connection": "close"}).json() for _ in range(8)]
        return {answer["mqtt"]["connection"] for answer in answers}

    def listeners() -> list[psutil.Process]:
        workers = psutil.Process(server.process.pid).children()
        ports = [[c.raddr.port for c in worker.net_connections("tcp") if c.raddr] for worker in workers]
        return [worker for worker, found in zip(workers, ports, strict=True) if mosquitto.port in found]

    with start_server(hall_table_path, workers=2, settings={"mqtt": source}) as server:
        server.wait_for("reading 'silabs/aoa/angle/+/+'")
        until(lambda: connections() == {"connected"})
        # One track has all, and each packet is answered once.
        for number in (1, 2, 3):
            ((_, document),) = asyncio.run(exchange(mosquitto.address, angles(number), answers=1))
            assert document["track"]["num_reports"] == number
        with server.client() as http:
            assert 'rayfix_reports_total{outcome="answered",source="mqtt"} 3.0' in http.get("/metrics").text
            # By HTTP, whichever worker answers would have a track of its own.
            refused = http.post("/v1/positions?track=true", json={**REPORT, "target_id": "a"})
            assert refused.status_code == 422
            assert [error["path"] for error in refused.json()["errors"]] == ["track"]
            assert "one worker" in refused.json()["detail"]
        (listener,) = listeners()
        listener.kill()
        server.wait_for("reading 'silabs/aoa/angle/+/+'", 2)
        until(lambda: connections() == {"connected"})
        assert len(listeners()) == 1
        assert len(asyncio.run(exchange(mosquitto.address, angles(9), answers=1))) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--track", "--workers", "2"], "track is set with 2 workers, among which a target's reports would be split"),
        (["--mqtt-topic", "a/+/+"], "--mqtt-topic is for an MQTT broker; name it by --mqtt HOST"),
        (["--mqtt", "mqtt://host"], "give HOST or HOST:PORT"),
        (["--mqtt", "localhost", "--mqtt-window", "0"], "window is 0"),
        (
            ["--mqtt", "localhost", "--mqtt-station", "a=nowhere"],
            "a is mapped to station 'nowhere', which is not in the",
        ),
        (["--mqtt", "localhost", "--mqtt-table", "other"], "there is no 'other'; give --mqtt-table, one of hall"),
    ],
)
def test_what_cannot_work_is_refused_before_the_service_listens(
    arguments: list[str], words: str, hall_table_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["serve", str(hall_table_path), "--port", "0", *arguments]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("rayfix: ")
    assert words in last


def test_the_options_are_those_of_the_command_of_its_own(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RAYFIX_MQTT_PASSWORD", "secret")
    words = (
        "serve tables --mqtt broker --mqtt-table hall --mqtt-topic a/+/+ --mqtt-publish b/{target_id} "
        "--mqtt-output omlox --mqtt-station x=bs1 --mqtt-station y=bs2 --mqtt-height 1.2 0.1 "
        "--mqtt-confidence 0.9 --mqtt-window 0.1 --mqtt-frame north --mqtt-tls --mqtt-username rayfix"
    )
    parser = make_parser()
    assert mqtt_source(parser.parse_args([*words.split(), "--track"])) == MqttSource(
        broker=Broker(host="broker", port=8883, username="rayfix", password="secret", tls=True),
        settings=MqttSettings(
            topic="a/+/+",
            publish="b/{target_id}",
            output="omlox",
            stations={"x": "bs1", "y": "bs2"},
            height=Height(z=1.2, stdev=0.1),
            confidence=0.9,
            window=0.1,
            frame="north",
            track=True,
        ),
        table="hall",
    )
    monkeypatch.delenv("RAYFIX_MQTT_PASSWORD")
    plain = parser.parse_args(["serve", "tables", "--mqtt", "broker"])
    assert mqtt_source(plain) == MqttSource(broker=Broker(host="broker"))
    assert mqtt_source(parser.parse_args(["serve", "tables", "--track"])) is None
    # Whatever the other command can be told, this one can.
    own, served = (
        {option for action in command._actions for option in action.option_strings}
        for name, command in parser._subparsers._group_actions[0].choices.items()  # type: ignore[union-attr]
        if name in ("mqtt", "serve")
    )
    if "--mqtt" in own:
        own, served = served, own
    common = {"-h", "--help", "--omlox-hub", "--hub-answer-kib", "--broker"}
    assert {option.replace("--", "--mqtt-", 1) for option in own - common} <= served


def test_the_stations_are_those_of_the_table_that_is_served_now():
    """Of a new table with other stations, or the first message would never be read."""

    async def no_answer(adapted: Adapted) -> dict[str, Any]:
        raise AssertionError

    def site_of(*names: str) -> SiteInfo:
        stations = tuple(Station(id=name, position=(0.0, 0.0, 0.0)) for name in names)
        return SiteInfo(name="site", north=0.0, max_path_length=100.0, stations=stations)

    served, outcomes = [site_of("a")], list[str]()
    settings = MqttSettings()
    session = MqttSession(
        settings=settings,
        stream=angle_stream(served[0], settings),
        answer=no_answer,
        on_message=outcomes.append,
        site=lambda: served[0],
    )
    payload = json.dumps(angles()[0][1]).encode()
    assert session._receive("x/b/tag", payload) == []
    served[0] = site_of("b", "c")
    assert session._receive("x/b/tag", payload) == []  # waits for c
    assert session._receive("x/b/tag", payload) == []  # the same once more
    (adapted,) = session._receive("x/c/tag", payload)
    assert {measurement.station_id for measurement in adapted.report.measurements} == {"b", "c"}
    assert outcomes == ["passed_over", "taken", "repeated", "taken"]


def test_without_the_extra_the_service_says_which(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], hall_table_path: Path
):
    monkeypatch.delitem(sys.modules, "rayfix_service.adapters.mqtt.session", raising=False)
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    assert main(["serve", str(hall_table_path), "--mqtt", "localhost"]) == 2
    assert "'aiomqtt' is not installed; install it with: pip install 'rayfix[mqtt]'" in capsys.readouterr().err
