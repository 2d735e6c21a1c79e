"""When answers are written to a connection."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from rayfix_service.server.protocol import GatheringTransport

HEAD, BODY = b"HTTP/1.1 200 OK\r\n\r\n", b"{}"
LONG = bytes(1 << 16)


class _Recorder(asyncio.Transport):
    """A transport that notes what it is asked to do; each call to write is a system call of a real one."""

    def __init__(self) -> None:
        super().__init__({"peername": "a client"})
        self.calls: list[tuple[str, bytes]] = []
        self.closing = False

    def writelines(self, pieces: Any) -> None:
        self.calls.append(("write", b"".join(pieces)))

    def write_eof(self) -> None:
        self.calls.append(("write_eof", b""))

    def close(self) -> None:
        self.calls.append(("close", b""))

    def is_closing(self) -> bool:
        return self.closing

    def get_write_buffer_size(self) -> int:
        return 0


def calls_of(*turns: Callable[[GatheringTransport], None]) -> list[tuple[str, bytes]]:
    """Return what the connection is asked to do, with an empty entry at the end of each of some turns of the loop."""
    recorder = _Recorder()

    async def run() -> None:
        transport = GatheringTransport(recorder, asyncio.get_running_loop())
        for turn in turns:
            turn(transport)
            await asyncio.sleep(0)
            recorder.calls.append(("", b""))

    asyncio.run(run())
    return recorder.calls


TURN = ("", b"")


def test_what_is_written_in_one_turn_goes_out_in_one_piece():
    def answer(transport: GatheringTransport) -> None:
        transport.write(HEAD)
        transport.write(BODY)

    def two_answers(transport: GatheringTransport) -> None:
        answer(transport)
        transport.writelines([HEAD, BODY])

    once, twice = ("write", HEAD + BODY), ("write", 2 * (HEAD + BODY))
    assert calls_of(answer) == [once, TURN]
    assert calls_of(answer, answer) == [once, TURN, once, TURN]
    assert calls_of(two_answers) == [twice, TURN]


def test_a_stream_is_not_held_back():
    def head(transport: GatheringTransport) -> None:
        transport.write(HEAD)

    def event(transport: GatheringTransport) -> None:
        transport.write(BODY)

    assert calls_of(head, event) == [("write", HEAD), TURN, ("write", BODY), TURN]


def test_what_is_long_goes_out_at_once_and_in_its_order():
    def answer(transport: GatheringTransport) -> None:
        transport.write(HEAD)
        transport.write(LONG)
        transport.write(BODY)

    assert calls_of(answer) == [("write", HEAD + LONG), ("write", BODY), TURN]


@pytest.mark.parametrize("end", ["close", "write_eof"])
def test_the_end_comes_after_all_that_was_written(end: str):
    def refuse(transport: GatheringTransport) -> None:
        transport.write(HEAD)
        transport.write(BODY)
        getattr(transport, end)()

    assert calls_of(refuse) == [("write", HEAD + BODY), (end, b""), TURN]


def test_nothing_is_written_to_a_connection_that_is_lost():
    recorder = _Recorder()

    async def run() -> None:
        transport = GatheringTransport(recorder, asyncio.get_running_loop())
        transport.write(HEAD)
        recorder.closing = True
        await asyncio.sleep(0)
        transport.close()

    asyncio.run(run())
    assert recorder.calls == [("close", b"")]


def test_all_else_is_the_connections_own():
    async def run() -> GatheringTransport:
        return GatheringTransport(_Recorder(), asyncio.get_running_loop())

    transport = asyncio.run(run())
    assert transport.get_extra_info("peername") == "a client"
    assert not transport.is_closing()
