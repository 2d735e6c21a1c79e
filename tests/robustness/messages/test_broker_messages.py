"""Messages of a broker that are odd or come twice cost themselves at most."""

import asyncio
import json
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rayfix_service.adapters.mqtt.session import check_settings, topic_for
from rayfix_service.adapters.mqtt.settings import BrokerError, MqttSettings
from rayfix_service.adapters.silabs_stream import PAYLOAD_BYTES, SilabsStream
from rayfix_service.locator import Locator
from rayfix_service.wire.names import MAX_NAME, in_log, topic_level
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table
from tests.support.running.mqtt_broker import MESSAGE, TAG, Mosquitto, angles, broker_in, exchange, locating

SETTINGS = MqttSettings(window=0.5, stations=MESSAGE["stations"])

SITE = SiteInfo(
    name="hall",
    north=0.0,
    max_path_length=60.0,
    document={},
    stations=tuple(
        Station(id=name, position=(0.0, 0.0, 2.0), orientation=(0.0, 0.0, 0.0), field_of_view=6.3)
        for name in ("bs1", "bs2", "bs3")
    ),
)


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    locator = Locator(Table.open(hall_table_path))
    locator.warm_up()
    return locator


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    with broker_in(tmp_path) as broker:
        broker.start()
        yield broker


def test_messages_that_are_delivered_twice_end_no_packet(mosquitto: Mosquitto, locator: Locator):
    """Three packets of which every message came twice became 15 answers."""
    twice = [message for sequence in (7, 8, 9) for message in angles(sequence) for _ in range(2)]

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, mosquitto.address, SETTINGS):
            answers = await exchange(mosquitto.address, twice, answers=3, qos=1)
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(1.5):
                    await exchange(mosquitto.address, [], answers=1)
            return answers

    answers = asyncio.run(scenario())
    assert [len(document["measurements"]) for _, document in answers] == [3, 3, 3]


def test_odd_topics_cost_their_messages(mosquitto: Mosquitto, locator: Locator, caplog: pytest.LogCaptureFixture):
    """A tag whose name made the topic of its position longer than MQTT allows ended the process."""
    long = "t" * 65_000
    odd = [*angles(1, long), *angles(1, "100%"), *angles(1, "$SYS"), ("silabs/aoa/angle/" + "l" * 60_000 + "/t", {})]
    settings = replace(SETTINGS, window=0.1, publish="rayfix/position/of/a/tag/in/the/hall/{target_id}")
    settings = replace(settings, topic="silabs/#", publish=settings.publish + "/" + "x" * 500)

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, mosquitto.address, settings):
            return await exchange(mosquitto.address, [*odd, *angles(7)], answers=3)

    with caplog.at_level(logging.INFO, logger="rayfix_service"):
        answers = asyncio.run(scenario())
    assert {topic.split("/")[-2] for topic, _ in answers} == {"100%25", "%24SYS", TAG}
    assert {document["target_id"] for _, document in answers} == {"100%", "$SYS", TAG}
    lines = [record.getMessage() for record in caplog.records if record.name.startswith("rayfix_service")]
    assert any("has 65000 characters; give it at most 256" in line for line in lines)
    assert all(len(line) < 1000 for line in lines)
    assert "4 messages passed over, 0 delivered twice" in lines[-1]


def test_a_defect_costs_the_message_that_meets_it(
    mosquitto: Mosquitto, locator: Locator, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    """Any error of the reading of one message ended the process."""
    receive = SilabsStream.receive

    def failing(self: SilabsStream, topic: str, payload: bytes, now: float) -> Any:
        if payload == b"bad":
            raise RuntimeError("a defect")
        return receive(self, topic, payload, now)

    monkeypatch.setattr(SilabsStream, "receive", failing)

    async def scenario() -> list[tuple[str, dict[str, Any]]]:
        async with locating(locator, mosquitto.address, SETTINGS):
            return await exchange(mosquitto.address, [("silabs/aoa/angle/a/b", b"bad"), *angles(7)], answers=1)

    assert len(asyncio.run(scenario())) == 1
    assert any("a message of 'silabs/aoa/angle/a/b' failed" in record.getMessage() for record in caplog.records)


def payload(sequence: int | None, azimuth: float = 1.0) -> bytes:
    angle = {"azimuth": azimuth, "azimuth_stdev": 1.0, "sequence": sequence}
    return json.dumps({key: value for key, value in angle.items() if value is not None}).encode()


@pytest.mark.parametrize("sequence", [5, None])
def test_a_repeated_angle_is_taken_once_and_another_one_begins_a_packet(sequence: int | None):
    stream = SilabsStream(SITE, window=1.0)
    for _ in range(3):
        assert stream.receive("a/bs1/t", payload(sequence), 0.0) == []
        assert stream.receive("a/bs2/t", payload(sequence), 0.1) == []
    assert stream.num_repeated == 4
    (ended,) = stream.receive("a/bs1/t", payload(sequence, 2.0), 0.2)
    assert [measurement.station_id for measurement in ended.report.measurements] == ["bs1", "bs2"]


@given(st.lists(st.tuples(st.sampled_from(["bs1", "bs2", "bs3"]), st.integers(0, 4)), max_size=12), st.randoms())
def test_repeats_change_nothing(messages: list[tuple[str, int]], random: Any):
    """What comes out is the same when each message is delivered again, at once or after others of its packet."""
    once = list(dict.fromkeys(messages))

    def reports(sent: list[tuple[str, int]]) -> list[tuple[str | None, int]]:
        stream = SilabsStream(SITE, window=1.0)
        found = [one for name, n in sent for one in stream.receive(f"a/{name}/t{n}", payload(n), 0.0)]
        return sorted((one.report.target_id, len(one.report.measurements)) for one in [*found, *stream.due(1.0)])

    again = list(once)
    for message in once:
        again.insert(random.randint(again.index(message) + 1, len(again)), message)
    assert reports(again) == reports(once)


def test_what_is_remembered_of_a_broker_is_limited():
    """Packets without end, each heard by one locator, filled the memory for as long as they waited."""
    stream = SilabsStream(SITE, window=60.0)
    ended = sum(len(stream.receive(f"a/bs1/t{n}", payload(n), 0.0)) for n in range(21_000))
    assert ended == 1000
    assert stream.receive("a/bs1/t", b" " * (PAYLOAD_BYTES + 1), 0.0) == []
    assert stream.num_passed_over == 1
    short = SilabsStream(SITE, window=60.0, payload_bytes=20)
    assert short.receive("a/bs1/t", payload(1), 0.0) == []
    assert short.num_passed_over == 1


def test_the_log_has_a_line_for_a_message_whatever_its_topic_holds(caplog: pytest.LogCaptureFixture):
    """A locator's name could begin a line of the log that looks like one of rayfix."""
    stream = SilabsStream(SITE, window=1.0)
    with caplog.at_level(logging.DEBUG, logger="rayfix_service"):
        for topic in ("a/x\nINFO: forged\x1b[2J\u2028/t", "\n", "a/bs1/" + "\n" * 300, "a/" + "b" * 60_000 + "/t"):
            assert stream.receive(topic, b"{}", 0.0) == []
    assert len(caplog.records) == 4
    for record in caplog.records:
        assert record.getMessage().isprintable()
        assert len(record.getMessage()) < 500


@given(st.text(alphabet=st.characters() | st.sampled_from("/+#%$\0\n\ud800"), max_size=MAX_NAME))
def test_a_name_is_one_level_of_a_topic(name: str):
    topic = topic_for("rayfix/{target_id}/position", name)
    assert topic.count("/") == 2
    assert set(topic).isdisjoint("+#\0\n")
    assert len(topic.encode()) < 65_535
    aiomqtt.Topic(topic)
    assert in_log(name).isprintable()


@given(st.lists(st.text(alphabet="/+#%2Fa$\0", min_size=1, max_size=4), unique=True, min_size=2, max_size=2))
def test_two_names_are_two_levels(names: list[str]):
    assert topic_level(names[0]) != topic_level(names[1])


@pytest.mark.parametrize("name", ["ble-pd-84FD27EEE588", "tag 1", "Stapler-Ä", "a.b:c_d"])
def test_usual_names_stay_as_they_are(name: str):
    assert topic_level(name) == in_log(name) == name


@pytest.mark.parametrize(
    "publish",
    ["a/{target_id.upper}", "a/{target_id!r}", "a/{target_id:>9}", "a/\0/{target_id}", "a" * 65_000 + "/{target_id}"],
)
def test_a_topic_that_could_fail_later_is_refused_at_the_start(publish: str):
    with pytest.raises(BrokerError, match="cannot be published to") as refused:
        check_settings(replace(SETTINGS, publish=publish))
    assert len(str(refused.value)) < 500
