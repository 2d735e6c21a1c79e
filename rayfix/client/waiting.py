"""Pauses and web sockets, for asyncio and blocking: the parts of the two clients that differ by more than ``await``.

The generator of the blocking client replaces ``async_pause`` by ``pause``, and so on.
"""

import asyncio
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rayfix.extras import needs_extra

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection as AsyncSocket
    from websockets.asyncio.client import connect as AsyncConnect  # noqa: N812 -- it is a class
    from websockets.sync.client import ClientConnection as Socket


async def async_pause(seconds: float) -> None:
    """Wait, for asyncio."""
    await asyncio.sleep(seconds)


def pause(seconds: float) -> None:
    """Wait."""
    time.sleep(seconds)


def async_connect(url: str, headers: Mapping[str, str]) -> "AsyncConnect":
    """Open a web socket, for asyncio; the result is an asynchronous context manager."""
    with needs_extra("client"):
        from websockets.asyncio.client import connect
    return connect(url, additional_headers=headers)


def connect(url: str, headers: Mapping[str, str]) -> "Socket":
    """Open a web socket; the result is a context manager."""
    with needs_extra("client"):
        from websockets.sync.client import connect
    return connect(url, additional_headers=headers)


async def async_receive(socket: "AsyncSocket", timeout: float) -> str | bytes:
    """Receive a message, for asyncio.

    Raises
    ------
    TimeoutError
        When none comes within that many seconds.
    """
    async with asyncio.timeout(timeout):
        return await socket.recv()


def receive(socket: "Socket", timeout: float) -> str | bytes:
    """Receive a message.

    Raises
    ------
    TimeoutError
        When none comes within that many seconds.
    """
    return socket.recv(timeout)
