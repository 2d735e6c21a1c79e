"""Whether the MQTT broker of a service is connected, and which of its workers reads it."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Literal

from rayfix_tables.disk.ownership import try_lock

BrokerConnection = Literal["connected", "lost"]

_TURN_SECONDS = 0.5
_CONNECTED, _LOST = b"1", b"0"


class BrokerState:
    """The state of the connection to a broker, common to all workers of a service.

    The worker that holds the lock on a file of their common folder reads the broker, and writes into the file whether
    it is connected. The system takes the lock away when that worker ends, however it ends.

    Parameters
    ----------
    address : str
        Host and port of the broker.
    folder : pathlib.Path or None
        Common folder of the workers; None for a single process.
    """

    def __init__(self, address: str, folder: Path | None) -> None:
        self.address = address
        self._file = None if folder is None else folder / "mqtt"
        self._descriptor: int | None = None
        self._connected = False

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait until no other worker reads the broker; until the context ends, none does."""
        if self._file is None:
            yield
            return
        descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            while not try_lock(descriptor):
                await asyncio.sleep(_TURN_SECONDS)
            self._descriptor = descriptor
            self.set(False)
            yield
            self.set(False)
        finally:
            self._descriptor = None
            os.close(descriptor)

    def set(self, connected: bool) -> None:
        """Note whether this process, which has the turn, is connected."""
        self._connected = connected
        if self._descriptor is not None:
            os.pwrite(self._descriptor, _CONNECTED if connected else _LOST, 0)

    def connection(self) -> BrokerConnection:
        """Return the state, whichever worker reads the broker."""
        connected = self._connected
        if self._file is not None:
            try:
                connected = self._file.read_bytes() == _CONNECTED
            except OSError:  # none has begun
                connected = False
        return "connected" if connected else "lost"
