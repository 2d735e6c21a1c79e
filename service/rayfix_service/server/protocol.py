"""The HTTP protocol of the server: uvicorn's, with answers written in one piece at the end of the loop's turn."""

import asyncio
from collections.abc import Iterable
from typing import Any, cast

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

_MOST_HELD = 1 << 16  # bytes; what is long is worth a system call, and the flow control has to know of it


class GatheringTransport:
    """A transport that writes what it gets within one turn of the loop at the end of that turn, in one system call.

    The server hands over the head of an answer and its body apart, and uvloop would write each at once. A write that
    wakes the client takes long; those at the end of a turn, of the answers to all that was ready in it, mostly find it
    awake.

    Parameters
    ----------
    transport : asyncio.Transport
        Does all that is not written here.
    loop : asyncio.AbstractEventLoop
    """

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._transport = transport
        self._loop = loop
        self._held: list[bytes] = []
        self._length = 0

    def __getattr__(self, name: str) -> Any:
        """Find what is not written here."""
        return getattr(self._transport, name)

    def write(self, data: bytes) -> None:
        """Write a piece at the end of the turn, or at once where much is held."""
        if not self._held:
            self._loop.call_soon(self._flush)
        self._held.append(data)
        self._length += len(data)
        if self._length > _MOST_HELD:
            self._flush()

    def writelines(self, pieces: Iterable[bytes]) -> None:
        """Write several pieces."""
        for piece in pieces:
            self.write(piece)

    def write_eof(self) -> None:
        """Write all, and end this side of the connection."""
        self._flush()
        self._transport.write_eof()

    def is_closing(self) -> bool:
        """Whether the connection is closed or about to be."""
        return self._transport.is_closing()

    def close(self) -> None:
        """Write all, and close the connection."""
        self._flush()
        self._transport.close()

    def _flush(self) -> None:
        held, self._held, self._length = self._held, [], 0
        if held and not self._transport.is_closing():
            self._transport.writelines(held)


class GatheringProtocol(HttpToolsProtocol):
    """HTTP/1.1 by httptools over a :class:`GatheringTransport`."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection."""
        super().connection_made(cast("asyncio.Transport", GatheringTransport(transport, self.loop)))
