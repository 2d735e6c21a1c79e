"""Angles from a real MQTT broker, positions back to it."""

import asyncio
import json
import logging
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rayfix.cli import main
from rayfix_service.adapters.formats import write
from rayfix_service.adapters.mqtt.session import check_settings
from rayfix_service.adapters.mqtt.settings import Broker, BrokerError, MqttSettings, parse_broker
from rayfix_service.adapters.omlox_hub import HubSettings
from rayfix_service.adapters.silabs import parse_silabs
from rayfix_service.adapters.silabs_stream import SilabsStream
from rayfix_service.fusion.measurements.report import Height
from rayfix_service.locator import Locator
from rayfix_tables.table import Table
from tests.support.running.mqtt_broker import MESSAGE, TAG, Mosquitto, angles, broker_in, exchange, locating

STATIONS: dict[str, str] = MESSAGE["stations"]
# A table of four stations and three locators: a packet waits for the fourth.
SETTINGS = MqttSettings(window=0.4, stations=STATIONS)


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    locator = Locator(Table.open(hall_table_path))
    locator.warm_up()
    return locator


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    with broker_in(tmp_path) as broker:
        yield broker


def run(coroutine: Callable[[], Any]) -> Any:
    return asyncio.run(coroutine())


def test_a_packet_becomes_a_position(mosquitto: Mosquitto, locator: Locator):
    mosquitto.start()

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, mosquitto.address, SETTINGS):
            return await exchange(mosquitto.address, angles(), answers=1)

    ((topic, document),) = run(scenario)
    assert topic == f"rayfix/position/{TAG}"
    # The same as the angles together give over HTTP.
    expected = locator.locate(parse_silabs(MESSAGE).report)
    assert document["position"] == write(expected, "native", locator.table.site, compute_seconds=0.0)["position"]
    assert document["target_id"] == TAG
    assert {outcome["source"] for outcome in document["measurements"]} == {"bs1", "bs2", "bs3"}
    assert document["timestamp"].endswith("Z")


def test_tags_are_followed_and_a_hub_is_told(mosquitto: Mosquitto, locator: Locator):
    mosquitto.start()
    told: list[tuple[str, dict[str, Any]]] = []

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        (length,) = (int(line.split(":")[1]) for line in head.splitlines() if line.lower().startswith("content-length"))
        told.append((head.splitlines()[0], json.loads(await reader.readexactly(length))))
        writer.write(b"HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n")
        await writer.drain()
        writer.close()

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with await asyncio.start_server(answer, "127.0.0.1", 0) as server:
            url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v2"
            settings = replace(SETTINGS, window=0.1, track=True, hub=HubSettings(url=url))
            async with locating(locator, mosquitto.address, settings):
                answers = []
                for sequence in (1, 2, 3):
                    answers += await exchange(mosquitto.address, angles(sequence), answers=1)
            # The end of the session waits for what is on its way.
            return answers

    answers = run(scenario)
    tracks = [document["track"] for _, document in answers]
    assert [(track["state"], track["num_reports"]) for track in tracks] == [
        ("started", 1),
        ("updated", 2),
        ("updated", 3),
    ]
    assert [line for line, _ in told] == [f"PUT /v2/providers/{TAG}/location HTTP/1.1"] * 3
    for (_, location), track in zip(told, tracks, strict=True):
        assert location["position"]["coordinates"] == list(track["position"].values())


def test_packets_are_joined_by_sequence_and_published_in_the_format_asked_for(mosquitto: Mosquitto, locator: Locator):
    mosquitto.start()
    settings = replace(SETTINGS, output="omlox", publish="hub/{target_id}/location")
    mixed = [message for pair in zip(angles(1), angles(2), strict=True) for message in pair]

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, mosquitto.address, settings):
            return await exchange(mosquitto.address, mixed, answers=2, topic="hub/#")

    first, second = run(scenario)
    assert first[0] == second[0] == f"hub/{TAG}/location"
    assert first[1]["provider_id"] == TAG
    assert first[1]["position"] == second[1]["position"]


def test_what_cannot_be_used_is_passed_over(mosquitto: Mosquitto, locator: Locator, caplog: pytest.LogCaptureFixture):
    mosquitto.start()
    (topic, payload), *_ = angles()
    messages: list[tuple[str, Any]] = [
        (topic, b"\xff not JSON"),
        (topic, None),
        (topic, {**payload, "elevation": 91}),
        (f"silabs/aoa/angle/stranger/{TAG}", payload),
        *angles(7),
    ]

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, mosquitto.address, SETTINGS):
            return await exchange(mosquitto.address, messages, answers=1)

    with caplog.at_level(logging.WARNING, logger="rayfix_service"):
        ((_, document),) = run(scenario)
    assert {outcome["source"] for outcome in document["measurements"]} == {"bs1", "bs2", "bs3"}
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 2, told  # one of each locator
    assert "is not JSON" in told[0]
    assert "station 'stranger' is not in the table" in told[1]


def test_a_lost_connection_is_made_again(mosquitto: Mosquitto, locator: Locator):
    mosquitto.start()

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, mosquitto.address, SETTINGS) as ready:
            mosquitto.stop()
            mosquitto.start()
            async with asyncio.timeout(20):
                await ready.get()
            return await exchange(mosquitto.address, angles(), answers=1)

    assert len(run(scenario)) == 1


def test_a_password_is_used(mosquitto: Mosquitto, locator: Locator):
    passwords = mosquitto.folder / "passwords"
    tool = shutil.which("mosquitto_passwd")
    if tool is None:
        pytest.skip("mosquitto_passwd is not installed")
    subprocess.run([tool, "-c", "-b", str(passwords), "rayfix", "secret"], check=True, capture_output=True)
    mosquitto.start("allow_anonymous false", f"password_file {passwords}")
    broker = replace(mosquitto.address, username="rayfix", password="secret")
    assert "secret" not in repr(broker)

    async def scenario(who: Broker) -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, who, SETTINGS):
            return await exchange(broker, angles(), answers=1)

    assert len(run(lambda: scenario(broker))) == 1
    with pytest.raises(BrokerError, match=rf"cannot use the MQTT broker 127.0.0.1:{mosquitto.port} \(.*[Aa]uthori"):
        run(lambda: scenario(mosquitto.address))


def test_the_command_serves_until_told_to_end(mosquitto: Mosquitto, hall_table_path: Path):
    mosquitto.start()
    stations = [word for name, station in STATIONS.items() for word in ("--station", f"{name}={station}")]
    command = [sys.executable, "-m", "rayfix", "mqtt", str(hall_table_path), "--broker", f"127.0.0.1:{mosquitto.port}"]
    process = subprocess.Popen([*command, *stations, "--output", "3gpp"], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if "reading 'silabs/aoa/angle/+/+'" in line:
                break
        ((_, document),) = run(lambda: exchange(mosquitto.address, angles(), answers=1))
        assert document["shape"] == "LOCAL_3D_POINT_UNCERTAINTY_ELLIPSOID"
        process.send_signal(signal.SIGTERM)
        _, rest = process.communicate(timeout=20)
        assert process.returncode == 0, rest
        assert "Traceback" not in rest
    finally:
        process.kill()
        process.wait()


def test_without_broker_there_is_one_line(capsys: pytest.CaptureFixture[str], hall_table_path: Path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, but nobody listens
        port = taken.getsockname()[1]
        handlers = list(logging.getLogger().handlers)
        try:
            status = main(["mqtt", str(hall_table_path), "--broker", f"127.0.0.1:{port}"])
        finally:
            logging.getLogger().handlers[:] = handlers
    assert status == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith(f"rayfix: cannot use the MQTT broker 127.0.0.1:{port} (")


@pytest.mark.parametrize(
    ("text", "tls", "host", "port"),
    [
        ("localhost", False, "localhost", 1883),
        ("broker.example:1884", False, "broker.example", 1884),
        ("10.0.0.5", True, "10.0.0.5", 8883),
        ("[::1]:1883", False, "::1", 1883),
    ],
)
def test_addresses(text: str, tls: bool, host: str, port: int):
    broker = parse_broker(text, tls=tls)
    assert (broker.host, broker.port, broker.tls) == (host, port, tls)


@pytest.mark.parametrize("text", ["", ":1883", "host:port", "host:70000", "mqtt://host", "user@host"])
def test_what_is_no_address_is_refused(text: str):
    with pytest.raises(BrokerError, match="give HOST or HOST:PORT"):
        parse_broker(text)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"window": 0.0}, "window is 0; give more than 0 and at most 60"),
        ({"window": float("nan")}, "window is nan"),
        ({"publish": "rayfix/+"}, "cannot be published to"),
        ({"publish": "rayfix/{tag}"}, "no placeholder but {target_id}"),
        ({"publish": "rayfix/{"}, "cannot be published to"),
        ({"topic": "a/#/b"}, "'a/#/b' is not a topic filter"),
        ({"publish": "silabs/aoa/angle/rayfix/{target_id}"}, "is among those read"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, Any], words: str):
    check_settings(SETTINGS)
    with pytest.raises(BrokerError) as refused:
        check_settings(replace(SETTINGS, **changes))
    assert words in str(refused.value)


def test_a_packet_that_all_stations_heard_does_not_wait(locator: Locator):
    stream = SilabsStream(locator.table.site, window=1000.0, height=Height(z=1.2, stdev=0.1))
    payload = json.dumps({"azimuth": 1, "azimuth_stdev": 1, "sequence": 3}).encode()
    reports = [
        report
        for station in ("bs1", "bs2", "bs3", "bs4")
        for report in stream.receive(f"any/{station}/tag", payload, 5.0)
    ]
    (adapted,) = reports
    assert [m.station_id for m in adapted.report.measurements] == ["bs1", "bs2", "bs3", "bs4"]
    assert adapted.report.target_id == "tag"
    assert adapted.report.height == Height(z=1.2, stdev=0.1)
    assert stream.receive("short", payload, 5.0) == []
    stream.receive("any/bs1/tag", payload.replace(b"3", b"4"), 6.0)
    assert stream.due(1005.0) == []
    assert len(stream.due(1006.0)) == 1


@pytest.mark.parametrize("command", ["mqtt", "serve"])
def test_a_hub_that_is_no_address_is_one_line(
    command: str, hall_table_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(hall_table_path), "--omlox-hub", "hub:8081"]) == 2
    error = capsys.readouterr().err
    assert error == "rayfix: omlox hub 'hub:8081' is not an address; give that of its API, e.g. http://hub:8081/v2\n"


def test_without_the_extra_the_command_says_which(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], hall_table_path: Path
):
    for name in ("rayfix.mqtt", "rayfix_service.adapters.mqtt.session"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    assert main(["mqtt", str(hall_table_path)]) == 2
    assert "'aiomqtt' is not installed; install it with: pip install 'rayfix[mqtt]'" in capsys.readouterr().err
