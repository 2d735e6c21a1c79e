"""Positions to a hub: a real server on loopback that answers as it is told."""

import asyncio
import json
import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from rayfix_service.adapters.omlox_hub import HubError, HubSettings, OmloxHub, open_hub
from rayfix_service.http.openapi.examples import OMLOX_EXAMPLE


class Hub:
    """A hub that keeps what it was told, and the statuses that it will answer with before 204."""

    def __init__(self) -> None:
        self.statuses: list[int] = []
        self.told: list[tuple[str, dict[str, Any], str | None]] = []
        self.gate = threading.Event()
        self.gate.set()
        hub = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_PUT(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                hub.gate.wait(10)
                status = hub.statuses.pop(0) if hub.statuses else 204
                if status == 204:
                    hub.told.append((self.path, json.loads(body), self.headers["authorization"]))
                self.send_response(status)
                self.send_header("content-length", "0")
                self.end_headers()

            def log_message(self, *args: object) -> None: ...

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def url(self) -> str:
        """Address of its API."""
        return f"http://127.0.0.1:{self.server.server_address[1]}/v2"


@pytest.fixture
def hub() -> Iterator[Hub]:
    hub = Hub()
    yield hub
    hub.gate.set()
    hub.server.shutdown()
    hub.server.server_close()


def location(target: str, n: int = 0) -> dict[str, Any]:
    return {**OMLOX_EXAMPLE, "provider_id": target, "properties": {"n": n}}


def push(
    settings: HubSettings, locations: list[dict[str, Any]], during: Callable[[OmloxHub], None] = lambda hub: None
) -> Counter[str]:
    """Send locations and return what became of them."""
    outcomes: Counter[str] = Counter()

    async def scenario() -> None:
        async with open_hub(settings, on_outcome=lambda outcome: outcomes.update([outcome]), cooperation=5.0) as sender:
            assert sender is not None
            for one in locations:
                sender.put(one)
            during(sender)

    asyncio.run(scenario())
    return outcomes


def test_each_target_is_told_of_in_order(hub: Hub):
    locations = [location(f"tag/{target}", n) for n in range(20) for target in "abcdef"]
    outcomes = push(HubSettings(url=hub.url + "/", token="secret"), locations)
    assert outcomes == {"sent": 120}
    for target in "abcdef":
        path = f"/v2/providers/tag%2F{target}/location"
        assert [told[1]["properties"]["n"] for told in hub.told if told[0] == path] == list(range(20))
    assert {told[2] for told in hub.told} == {"Bearer secret"}
    assert all(told[1] in locations for told in hub.told)


def test_a_hub_that_fails_for_a_while_is_told_again(hub: Hub, caplog: pytest.LogCaptureFixture):
    hub.statuses = [503, 429, 500]
    with caplog.at_level(logging.INFO, logger="rayfix_service"):
        outcomes = push(HubSettings(url=hub.url, first_pause=0.01), [location("a", 1), location("a", 2)])
    assert outcomes == {"sent": 2}
    assert [told[1]["properties"]["n"] for told in hub.told] == [1, 2]
    assert [record.levelname for record in caplog.records if "omlox" in record.message] == ["WARNING", "INFO"]


def test_what_a_hub_refuses_is_not_sent_again(hub: Hub):
    hub.statuses = [404]
    outcomes = push(HubSettings(url=hub.url), [location("a", 1), location("a", 2)])
    assert outcomes == {"refused": 1, "sent": 1}
    assert [told[1]["properties"]["n"] for told in hub.told] == [2]


def test_a_hub_that_is_gone_costs_the_locations_and_nothing_else():
    settings = HubSettings(url="http://127.0.0.1:9", attempts=2, first_pause=0.01)
    assert push(settings, [location("a"), location("b")]) == {"dropped": 2}


def test_of_a_slow_hub_the_oldest_are_dropped(hub: Hub):
    hub.gate.clear()
    settings = HubSettings(url=hub.url, lanes=1, capacity=3)

    def release(sender: OmloxHub) -> None:
        # None has been sent: the loop has not run since the first was put.
        assert sender.num_waiting == 3
        hub.gate.set()

    outcomes = push(settings, [location("a", n) for n in range(10)], release)
    assert outcomes == {"dropped": 7, "sent": 3}
    assert [told[1]["properties"]["n"] for told in hub.told] == [7, 8, 9]


def test_at_the_end_patience_is_short(hub: Hub):
    hub.gate.clear()

    async def scenario() -> float:
        loop = asyncio.get_running_loop()
        async with open_hub(HubSettings(url=hub.url), cooperation=0.1) as sender:
            assert sender is not None
            sender.put(location("a"))
            begin = loop.time()
        return loop.time() - begin

    assert asyncio.run(scenario()) < 3.0
    assert hub.told == []


@pytest.mark.parametrize("url", ["hub:8081", "ftp://hub", "http://", "http://hub/v2?a=1"])
def test_an_address_that_is_none_is_refused(url: str):
    with pytest.raises(HubError, match="not an address"):
        HubSettings(url=url)


def test_without_settings_there_is_no_hub():
    async def scenario() -> None:
        async with open_hub(None) as hub:
            assert hub is None

    asyncio.run(scenario())
