"""Locate from an MQTT broker: subscribes to angles and publishes positions. Needs the extra ``rayfix[mqtt]``."""

import asyncio
import json
import logging
import ssl
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from string import Formatter
from time import monotonic, perf_counter
from typing import Any
from urllib.parse import urlsplit

import aiomqtt

from rayfix_service.adapters.adapted import Adapted, with_confidence
from rayfix_service.adapters.formats import OutputFormat, write
from rayfix_service.adapters.omlox_hub import HubSettings, OmloxHub, open_hub
from rayfix_service.adapters.silabs_stream import PAYLOAD_BYTES, SilabsStream
from rayfix_service.fusion.measurements.report import Frame, Height
from rayfix_service.locator import Locator
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire.names import MAX_NAME, in_log, topic_level
from rayfix_tables.errors import RayfixError, ReportError

_log = logging.getLogger(__name__)

_LONGEST_PAUSE = 30.0  # s, between attempts to connect again
_MOST_TOPIC_BYTES = 65_535  # of MQTT
_MOST_WAITING = 10_000  # messages; when they come faster than fixes are computed, the newest are dropped


class BrokerError(RayfixError):
    """The MQTT broker cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Broker:
    """Address of the broker, and the credentials for it."""

    host: str
    port: int = 1883
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: bool = False


@dataclass(frozen=True, kw_only=True)
class MqttSettings:
    """What to subscribe to, how to join messages, and what to publish.

    Attributes
    ----------
    topic : str
        Topic filter of locators' angles; topics must end in ``<locator>/<tag>``.
    publish : str
        Topic of positions; ``{target_id}`` stands for the tag.
    output : {"native", "3gpp", "omlox"}
        Format of positions.
    window : float, s
        How long to wait for more locators' angles of a packet.
    stations : Mapping
        Stations by locator; a locator that is not in the map is itself a station's identifier.
    frame : {"lcs", "scene", "north"}
        Frame of the angles.
    height : Height or None
        Known height of all tags.
    confidence : float or None
        Probability that the stated accuracies hold; None for 0.68.
    track : bool
        Whether tags are followed from packet to packet.
    hub : HubSettings or None
        Omlox hub that all positions are also sent to.
    payload_bytes : int
        Longest message that is read.
    """

    topic: str = "silabs/aoa/angle/+/+"
    publish: str = "rayfix/position/{target_id}"
    output: OutputFormat = "native"
    window: float = 0.5
    stations: Mapping[str, str] = field(default_factory=dict)
    frame: Frame = "lcs"
    height: Height | None = None
    confidence: float | None = None
    track: bool = False
    hub: HubSettings | None = None
    payload_bytes: int = PAYLOAD_BYTES


def parse_broker(text: str, *, tls: bool = False, username: str | None = None, password: str | None = None) -> Broker:
    """Read ``HOST`` or ``HOST:PORT``; the port is 1883, or 8883 with TLS, unless given.

    Raises
    ------
    BrokerError
        For anything else.
    """
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or parts.path or parts.query or parts.fragment or "@" in text:
        raise BrokerError(f"broker {text!r} is not an address; give HOST or HOST:PORT, e.g. localhost:1883")
    return Broker(host=host, port=port or (8883 if tls else 1883), username=username, password=password, tls=tls)


def check_settings(settings: MqttSettings) -> None:
    """Refuse topics that a broker does not accept, and topics by which positions would be read as angles.

    Raises
    ------
    BrokerError
    """
    if not 0.0 < settings.window <= 60.0:
        raise BrokerError(f"window is {settings.window:g}; give more than 0 and at most 60 seconds")
    try:
        topic = topic_for(settings.publish, "tag")
        length = len(topic_for(settings.publish, "\uffff" * MAX_NAME).encode())  # no name of a tag becomes longer
    except ValueError:
        topic, length = "", 0
    if not topic or set(topic) & set("+#\0") or length > _MOST_TOPIC_BYTES:
        raise BrokerError(
            f"topic {in_log(settings.publish)!r} cannot be published to; give a short one without +, # and control "
            "characters, and with no placeholder but {target_id}"
        )
    try:
        loops = aiomqtt.Topic(topic).matches(settings.topic)
    except ValueError:
        raise BrokerError(f"topic {settings.topic!r} is not a topic filter; give e.g. silabs/aoa/angle/+/+") from None
    if loops:
        raise BrokerError(f"topic {settings.publish!r} is among those read, {settings.topic!r}; give another")


def topic_for(publish: str, target_id: str) -> str:
    """Write the topic of a target's positions; the escaped name is one level of the topic.

    Raises
    ------
    ValueError
        When the topic has another placeholder than ``{target_id}``.
    """
    parts = []
    for text, name, form, conversion in Formatter().parse(publish):
        parts.append(text)
        if name is not None:
            if name != "target_id" or form or conversion:
                raise ValueError(publish)
            parts.append(topic_level(target_id))
    return "".join(parts)


async def run_mqtt(
    locator: Locator, broker: Broker, settings: MqttSettings, *, on_ready: Callable[[], None] | None = None
) -> None:
    """Locate until cancelled; a broken connection is established again, with pauses of 1 to 30 s.

    Parameters
    ----------
    locator : Locator
    broker : Broker
    settings : MqttSettings
    on_ready : callable, optional
        Called after each subscription.

    Raises
    ------
    BrokerError
        When a setting is out of range, or the first connection fails.
    """
    check_settings(settings)
    site = locator.table.site
    stream = SilabsStream(
        site,
        window=settings.window,
        stations=settings.stations,
        frame=settings.frame,
        height=settings.height,
        payload_bytes=settings.payload_bytes,
    )
    tracker = Tracker(locator.table) if settings.track else None
    async with open_hub(settings.hub) as hub:
        session = _Session(locator=locator, settings=settings, stream=stream, tracker=tracker, hub=hub)
        try:
            await _run_session(session, broker, on_ready)
        finally:
            _log.info("%s", session.summary())


async def _run_session(session: "_Session", broker: Broker, on_ready: Callable[[], None] | None) -> None:
    """Connect, and reconnect when the connection is lost."""
    address, topic = f"{broker.host}:{broker.port}", session.settings.topic
    connected, pause = False, 1.0
    while True:
        try:
            async with _client(broker) as client:
                await client.subscribe(topic)
                connected, pause = True, 1.0
                _log.info("reading '%s' from %s", topic, address)
                if on_ready is not None:
                    on_ready()
                await _first_of(session.read(client), session.watch(client))
        except (aiomqtt.MqttError, OSError, ValueError) as error:  # ValueError: of a topic that is none
            if not connected:
                text = f"cannot use the MQTT broker {address} ({error}); check its address and your rights"
                raise BrokerError(text) from error
            _log.warning("lost the broker %s (%s), trying again in %g s", address, in_log(str(error), most=1000), pause)
        await asyncio.sleep(pause)
        pause = min(2.0 * pause, _LONGEST_PAUSE)


def _client(broker: Broker) -> aiomqtt.Client:
    return aiomqtt.Client(
        broker.host,
        port=broker.port,
        username=broker.username,
        password=broker.password,
        tls_context=ssl.create_default_context() if broker.tls else None,
        max_queued_incoming_messages=_MOST_WAITING,
    )


async def _first_of(*coroutines: Coroutine[Any, Any, None]) -> None:
    """Run coroutines until the first one ends, normally with an exception, and cancel the others."""
    tasks = [asyncio.create_task(coroutine) for coroutine in coroutines]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@dataclass(frozen=True, kw_only=True)
class _Session:
    """Locates packets; holds the table and the state between packets."""

    locator: Locator
    settings: MqttSettings
    stream: SilabsStream
    tracker: Tracker | None
    hub: OmloxHub | None
    failed: Counter[str] = field(default_factory=Counter)

    def summary(self) -> str:
        """Describe how many messages and packets gave no position."""
        return (
            f"{self.stream.num_passed_over} messages passed over, {self.stream.num_repeated} delivered twice; "
            f"{self.failed['no position']} packets without a position, {self.failed['defect']} that failed"
        )

    async def read(self, client: aiomqtt.Client) -> None:
        """Process all messages; a message that cannot be read is skipped."""
        async for message in client.messages:
            if isinstance(message.payload, bytes):
                await self._publish(client, self._receive(message.topic.value, message.payload))

    def _receive(self, topic: str, payload: bytes) -> list[Adapted]:
        try:
            return self.stream.receive(topic, payload, monotonic())
        except Exception:
            self.failed["defect"] += 1
            _log.exception("a message of '%s' failed", in_log(topic))
            return []

    async def watch(self, client: aiomqtt.Client) -> None:
        """Locate packets whose window has passed, though some locators have not received them."""
        while True:
            await asyncio.sleep(0.1 * self.settings.window)
            await self._publish(client, self.stream.due(monotonic()))

    async def _publish(self, client: aiomqtt.Client, reports: list[Adapted]) -> None:
        for adapted in reports:
            target = in_log(adapted.report.target_id or "")
            try:
                document = json.dumps(self._answer(adapted))
            except ReportError as error:
                self.failed["no position"] += 1
                _log.info("no position of '%s': %s", target, in_log(str(error), most=1000))
                continue
            except Exception:
                # A defect in one packet's fix must not end the service.
                self.failed["defect"] += 1
                _log.exception("a packet of '%s' failed", target)
                continue
            try:
                await client.publish(topic_for(self.settings.publish, adapted.report.target_id or ""), document)
            except ValueError as error:  # of paho: a topic or a message that MQTT does not carry
                self.failed["defect"] += 1
                _log.error("a position of '%s' cannot be published: %s", target, error)

    def _answer(self, adapted: Adapted) -> dict[str, Any]:
        """Locate a packet, update its tag's track, and send the position to the hub."""
        begin = perf_counter()
        fused = self.locator.fuse(with_confidence(adapted, self.settings.confidence).report)
        seconds = perf_counter() - begin
        track = self.tracker.follow(fused) if self.tracker is not None else None
        site = self.locator.table.site
        if self.hub is not None:
            self.hub.tell(fused.fix, site, track)
        return write(fused.fix, self.settings.output, site, compute_seconds=seconds, adapted=adapted, track=track)
