"""An omlox hub that answers slowly, without end, or for other targets than it is told of."""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import closing, suppress
from typing import Any
from urllib.parse import unquote

import pytest

from rayfix_service.adapters.omlox_hub import HubSettings, open_hub
from rayfix_service.http.openapi.examples import OMLOX_EXAMPLE
from rayfix_service.wire.names import path_segment
from rayfix_tables.errors import ReportError

Answer = Callable[[asyncio.StreamWriter], Awaitable[None]]


def location(target: str) -> dict[str, Any]:
    return {**OMLOX_EXAMPLE, "provider_id": target}


def told_by(
    answers: Callable[[str], Answer], targets: list[str], *, cooperation: float = 20.0, **options: Any
) -> tuple[Counter[str], list[str], float]:
    """Tell a hub, which answers each path in its own way, of targets.

    Returns what became of them, the paths that the hub saw, and how long it took, s.
    """
    outcomes: Counter[str] = Counter()
    paths: list[str] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError), closing(writer):
            while True:
                head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
                lengths = [line for line in head.lower().splitlines() if line.startswith("content-length:")]
                await reader.readexactly(int(lengths[0].split(":")[1]))
                paths.append(head.split(" ")[1])
                await answers(paths[-1])(writer)
                await writer.drain()

    async def scenario() -> float:
        loop = asyncio.get_running_loop()
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        settings = HubSettings(
            url=f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v2", lanes=1, first_pause=0.01, **options
        )
        begin = loop.time()
        async with open_hub(
            settings, on_outcome=lambda outcome: outcomes.update([outcome]), cooperation=cooperation
        ) as hub:
            assert hub is not None
            for target in targets:
                hub.put(location(target))
        taken = loop.time() - begin
        server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        await asyncio.sleep(0)  # the connections close
        return taken

    return outcomes, paths, asyncio.run(scenario())


async def no_content(writer: asyncio.StreamWriter) -> None:
    writer.write(b"HTTP/1.1 204 No Content\r\n\r\n")


async def trickled_head(writer: asyncio.StreamWriter) -> None:
    """Send a byte of a head every 20 ms, 30 s long."""
    writer.write(b"HTTP/1.1 200 OK\r\nx: ")
    for _ in range(1500):
        writer.write(b"x")
        await writer.drain()
        await asyncio.sleep(0.02)


async def trickled_body(writer: asyncio.StreamWriter) -> None:
    """Send a byte of a body every 20 ms, 30 s long."""
    writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 4000\r\n\r\n")
    for _ in range(1500):
        writer.write(b"x")
        await writer.drain()
        await asyncio.sleep(0.02)


sent = {"bytes": 0}


async def huge_body(writer: asyncio.StreamWriter) -> None:
    """Send a body of 64 MB."""
    writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 64000000\r\n\r\n")
    for _ in range(1000):
        writer.write(bytes(64000))
        await writer.drain()
        sent["bytes"] += 64000


def by_target(slow: Answer) -> Callable[[str], Answer]:
    return lambda path: slow if "slow" in path else no_content


@pytest.mark.parametrize(("answer", "outcome"), [(trickled_head, "dropped"), (trickled_body, "sent")])
def test_an_answer_that_trickles_does_not_hold_the_lane(answer: Answer, outcome: str):
    """The time limit began anew with each byte, so that the lane waited for as long as the hub went on."""
    outcomes, _, taken = told_by(by_target(answer), ["slow", "a", "b"], timeout=0.5, attempts=2)
    assert outcomes == Counter(["sent", "sent", outcome])
    assert taken < 10.0


def test_of_a_huge_answer_little_is_read():
    """It was read as a whole, into memory."""
    sent["bytes"] = 0
    outcomes, _, _ = told_by(by_target(huge_body), ["slow", "a"])
    assert outcomes == {"sent": 2}
    assert sent["bytes"] < 32_000_000  # what the buffers of the connection hold


def test_how_much_of_an_answer_is_read_is_a_setting():
    """One that is read to its end leaves the connection open for the next."""
    for answer_bytes, closed in ((10, True), (100_000, False)):
        connections: list[int] = []

        async def answer(writer: asyncio.StreamWriter, seen: list[int] = connections) -> None:
            seen.append(writer.get_extra_info("peername")[1])
            writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 50000\r\n\r\n" + b"x" * 50_000)

        outcomes, _, _ = told_by(lambda path: answer, ["a", "b"], answer_bytes=answer_bytes)
        assert outcomes == {"sent": 2}
        assert (len(set(connections)) == 2) == closed


@pytest.mark.parametrize(
    "target", ["a/../b", "a?b=c", "a#b", "a\r\nhost: b", "a\0b", "\\..\\", "%2e%2e", "a b", "ü;=&+"]
)
def test_a_name_stays_one_segment_of_the_path(target: str):
    outcomes, paths, _ = told_by(lambda path: no_content, [target])
    assert outcomes == {"sent": 1}
    (path,) = paths
    assert path.count("/") == 4
    assert path.startswith("/v2/providers/")
    assert path.endswith("/location")
    segment = path.split("/")[3]
    assert unquote(segment) == target
    assert set(segment).isdisjoint("/?#\\ ")


@pytest.mark.parametrize("target", [".", "..", "\ud800"])
def test_a_name_that_would_change_the_path_is_refused(target: str, caplog: pytest.LogCaptureFixture):
    """The position of a target named ".." went to another resource of the hub."""
    outcomes, paths, _ = told_by(lambda path: no_content, [target, "a"])
    assert outcomes == {"refused": 1, "sent": 1}
    assert paths == ["/v2/providers/a/location"]
    told = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(told) == 1
    assert "cannot be part of an address; give the target another name" in told[0]
    with pytest.raises(ReportError, match="cannot be part of an address"):
        path_segment(target)
