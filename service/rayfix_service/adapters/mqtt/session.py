"""Reading angles from an MQTT broker and publishing positions there. Needs the extra ``rayfix[mqtt]``."""

import asyncio
import json
import logging
import ssl
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass, field
from string import Formatter
from time import monotonic, perf_counter
from typing import Any, Literal

import aiomqtt

from rayfix_service.adapters.adapted import Adapted, with_confidence
from rayfix_service.adapters.formats import write
from rayfix_service.adapters.mqtt.settings import Broker, BrokerError, MqttSettings
from rayfix_service.adapters.omlox_hub import open_hub
from rayfix_service.adapters.silabs_stream import SilabsStream
from rayfix_service.locator import Locator
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire.names import MAX_NAME, in_log, topic_level
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo

_log = logging.getLogger(__name__)

_LONGEST_PAUSE = 30.0  # s, between attempts to connect again
_MOST_TOPIC_BYTES = 65_535  # of MQTT
_MOST_WAITING = 10_000  # messages; when they come faster than fixes are computed, the newest are dropped

MessageOutcome = Literal["taken", "repeated", "passed_over"]
"""What became of a message: taken, dropped since it was delivered twice, or of no use."""

Answer = Callable[[Adapted], Awaitable[dict[str, Any]]]
"""Locates a packet and writes the position that is published; a ReportError says why there is none."""


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


def angle_stream(site: SiteInfo, settings: MqttSettings) -> SilabsStream:
    """Make what joins the angles of a broker into packets, for the stations of a site."""
    return SilabsStream(
        site,
        window=settings.window,
        stations=settings.stations,
        frame=settings.frame,
        height=settings.height,
        payload_bytes=settings.payload_bytes,
    )


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
    tracker = Tracker(locator.table) if settings.track else None
    async with open_hub(settings.hub) as hub:

        async def answer(adapted: Adapted) -> dict[str, Any]:
            begin = perf_counter()
            report = with_confidence(adapted, settings.confidence).report
            fused = locator.fuse(report, with_likelihood=tracker is not None)
            seconds = perf_counter() - begin
            track = tracker.follow(fused) if tracker is not None else None
            if hub is not None:
                hub.tell(fused.fix, site, track)
            return write(fused.fix, settings.output, site, compute_seconds=seconds, adapted=adapted, track=track)

        def connection_changed(connected: bool) -> None:
            if connected and on_ready is not None:
                on_ready()

        session = MqttSession(settings=settings, stream=angle_stream(site, settings), answer=answer)
        await session.run(broker, on_connection=connection_changed)


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
class MqttSession:
    """Reads a broker's angles, and publishes the positions of their packets.

    Attributes
    ----------
    settings : MqttSettings
    stream : SilabsStream
        Joins the angles; :func:`angle_stream` makes it.
    answer : callable
        Locates each packet.
    on_message : callable
        Called with what became of each message.
    site : callable, optional
        Returns the site whose stations are read now; without it, they stay those of the stream.
    failed : collections.Counter
        Packets without a position, and defects.
    """

    settings: MqttSettings
    stream: SilabsStream
    answer: Answer
    on_message: Callable[[MessageOutcome], None] = lambda outcome: None
    site: Callable[[], SiteInfo] | None = None
    failed: Counter[str] = field(default_factory=Counter)

    async def run(self, broker: Broker, *, on_connection: Callable[[bool], None], patient: bool = False) -> None:
        """Read until cancelled; a broken connection is established again, with pauses of 1 to 30 s.

        Parameters
        ----------
        broker : Broker
        on_connection : callable
            Called with True each time that the topics are subscribed to, and with False when the broker is lost.
        patient : bool
            Whether the first connection may fail, too, and is tried again.

        Raises
        ------
        BrokerError
            When the first connection fails, unless patient.
        """
        try:
            await self._run(broker, on_connection, patient)
        finally:
            _log.info("%s", self.summary())

    async def _run(self, broker: Broker, on_connection: Callable[[bool], None], patient: bool) -> None:
        topic, may_fail, pause = self.settings.topic, patient, 1.0
        while True:
            try:
                async with _client(broker) as client:
                    await client.subscribe(topic)
                    may_fail, pause = True, 1.0
                    _log.info("reading '%s' from %s", topic, broker.address)
                    on_connection(True)
                    await _first_of(self.read(client), self.watch(client))
            except (aiomqtt.MqttError, OSError, ValueError) as error:  # ValueError: of a topic that is none
                if not may_fail:
                    text = f"cannot use the MQTT broker {broker.address} ({error}); check its address and your rights"
                    raise BrokerError(text) from error
                on_connection(False)
                reason = in_log(str(error), most=1000)
                _log.warning("no connection to the broker %s (%s), trying again in %g s", broker.address, reason, pause)
            await asyncio.sleep(pause)
            pause = min(2.0 * pause, _LONGEST_PAUSE)

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
            await asyncio.sleep(0)  # a queue that is never empty would keep all else waiting

    def _receive(self, topic: str, payload: bytes) -> list[Adapted]:
        passed_over, repeated = self.stream.num_passed_over, self.stream.num_repeated
        try:
            if self.site is not None:
                self.stream.follow(self.site())
            reports = self.stream.receive(topic, payload, monotonic())
        except Exception:
            self.failed["defect"] += 1
            _log.exception("a message of '%s' failed", in_log(topic))
            self.on_message("passed_over")
            return []
        if self.stream.num_passed_over > passed_over:
            self.on_message("passed_over")
        else:
            self.on_message("repeated" if self.stream.num_repeated > repeated else "taken")
        return reports

    async def watch(self, client: aiomqtt.Client) -> None:
        """Locate packets whose window has passed, though some locators have not received them."""
        while True:
            await asyncio.sleep(0.1 * self.settings.window)
            await self._publish(client, self.stream.due(monotonic()))

    async def _publish(self, client: aiomqtt.Client, reports: list[Adapted]) -> None:
        for adapted in reports:
            target = in_log(adapted.report.target_id or "")
            try:
                document = json.dumps(await self.answer(adapted))
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
