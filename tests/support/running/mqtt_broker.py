"""A real MQTT broker on loopback, and clients of it."""

import asyncio
import json
import shutil
import socket
import subprocess
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from rayfix_service.adapters.mqtt.session import run_mqtt
from rayfix_service.adapters.mqtt.settings import Broker, MqttSettings
from rayfix_service.http.openapi.examples import SILABS_EXAMPLES
from rayfix_service.locator import Locator

MESSAGE: dict[str, Any] = SILABS_EXAMPLES["three_locators"]["value"]
TAG: str = MESSAGE["target_id"]


def angles(sequence: int = 1, tag: str = TAG) -> list[tuple[str, dict[str, Any]]]:
    """Topic and payload of each locator."""
    return [
        (
            f"silabs/aoa/angle/{angle['locator_id']}/{tag}",
            {key: value for key, value in {**angle, "sequence": sequence}.items() if key != "locator_id"},
        )
        for angle in MESSAGE["angles"]
    ]


@dataclass
class Mosquitto:
    """A broker on the loopback interface."""

    program: str
    folder: Path
    port: int
    process: subprocess.Popen[bytes] | None = None

    def start(self, *options: str) -> None:
        """Start it and wait until it listens."""
        config = self.folder / "mosquitto.conf"
        # Started by root, it would become a user that cannot read the test's folder; otherwise the line is ignored.
        lines = [f"listener {self.port} 127.0.0.1", "user root", *(options or ["allow_anonymous true"])]
        config.write_text("\n".join(lines) + "\n", encoding="utf-8")
        self.process = subprocess.Popen([self.program, "-c", str(config)], stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 10
        while True:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=1):
                return
            assert time.monotonic() < deadline, "the broker does not listen"
            time.sleep(0.02)

    def stop(self) -> None:
        """Stop it."""
        if self.process is not None:
            self.process.terminate()
            self.process.wait(10)
            self.process = None

    @property
    def address(self) -> Broker:
        """Where it is."""
        return Broker(host="127.0.0.1", port=self.port)


def find_mosquitto() -> str:
    """Return the broker's program; the test skips without it."""
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
    if program is None:
        pytest.skip("the MQTT broker mosquitto is not installed (Debian: apt-get install mosquitto)")
    return program


@contextmanager
def broker_in(folder: Path) -> Iterator[Mosquitto]:
    """Give a broker, which the test starts, and stop it at the end."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    broker = Mosquitto(program=find_mosquitto(), folder=folder, port=port)
    try:
        yield broker
    finally:
        broker.stop()


@asynccontextmanager
async def locating(locator: Locator, broker: Broker, settings: MqttSettings) -> AsyncIterator[asyncio.Queue[None]]:
    """Locate in the background; yields a queue that fills each time that it is ready."""
    ready: asyncio.Queue[None] = asyncio.Queue()
    work = asyncio.create_task(run_mqtt(locator, broker, settings, on_ready=lambda: ready.put_nowait(None)))
    getter = asyncio.create_task(ready.get())
    await asyncio.wait([work, getter], return_when=asyncio.FIRST_COMPLETED)
    getter.cancel()
    try:
        if work.done():
            work.result()
        yield ready
    finally:
        work.cancel()
        with suppress(asyncio.CancelledError):
            await work


async def exchange(
    broker: Broker, messages: list[tuple[str, Any]], *, answers: int, topic: str = "rayfix/position/#", qos: int = 0
) -> list[tuple[str, dict[str, Any]]]:
    """Publish messages and wait for so many answers."""
    async with aiomqtt.Client(
        broker.host, port=broker.port, username=broker.username, password=broker.password
    ) as client:
        await client.subscribe(topic)
        for to, payload in messages:
            await client.publish(to, payload if isinstance(payload, bytes | None) else json.dumps(payload), qos)
        received = []
        async with asyncio.timeout(20):
            async for message in client.messages:
                assert isinstance(message.payload, bytes)
                received.append((message.topic.value, json.loads(message.payload)))
                if len(received) == answers:
                    return received
    raise AssertionError("the broker ended the connection")
