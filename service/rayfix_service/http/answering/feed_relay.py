"""The feed of fixes across worker processes: a listener gets the fixes of all.

Each worker has a Unix socket in their common folder. One that has listeners connects to the others, which then
send it what they locate; where nobody listens, nothing is sent or written.
"""

import asyncio
import contextlib
import json
import logging
import os
from pathlib import Path

from rayfix_service.http.answering.feed import FixFeed

_SCAN_SECONDS = 1.0
_GREETING = b"\n"
_LONGEST_LINE = 32 << 20  # bytes; a report within its limit, and its fix

_NO_SOCKET = (
    "fixes of process %d do not reach the listeners of other workers, as the socket %s cannot be made: %s; set TMPDIR "
    "to a folder with a short path and room, and start the service again"
)

_log = logging.getLogger(__name__)


class FeedRelay:
    """Carries the events of one worker to the others, and theirs to its listeners.

    Parameters
    ----------
    feed : FixFeed
        Of this worker.
    folder : pathlib.Path
        Common folder of the workers.
    """

    def __init__(self, feed: FixFeed, folder: Path) -> None:
        self._feed = feed
        self._folder = folder
        self._own = folder / f"feed-{os.getpid()}.sock"
        self._connections: dict[Path, asyncio.Task[None]] = {}
        self._lock = asyncio.Lock()
        self._clients: set[asyncio.Task[None]] = set()

    async def keep(self) -> None:
        """Serve the other workers, and stay connected to them while there are listeners here; until it is cancelled.

        Without a place for its socket, the worker goes on and its fixes reach its own listeners alone.
        """
        try:
            server = await asyncio.start_unix_server(self._tell, self._own, limit=_LONGEST_LINE)
        except OSError as error:
            _log.error(_NO_SOCKET, os.getpid(), self._own, error)
            return
        try:
            while True:
                await asyncio.sleep(_SCAN_SECONDS)
                if self._feed.num_listeners:
                    await self.connect()
                else:
                    self._disconnect()
        finally:
            self._disconnect()
            server.close()
            for task in self._clients:
                task.cancel()
            self._own.unlink(missing_ok=True)

    async def connect(self) -> None:
        """Listen to all other workers."""
        async with self._lock:
            await self._connect()

    async def _connect(self) -> None:
        for path in self._folder.glob("feed-*.sock"):
            if path == self._own or (path in self._connections and not self._connections[path].done()):
                continue
            try:
                async with asyncio.timeout(_SCAN_SECONDS):
                    reader, writer = await asyncio.open_unix_connection(path, limit=_LONGEST_LINE)
                    await reader.readexactly(len(_GREETING))
            except ConnectionRefusedError:
                path.unlink(missing_ok=True)  # of a worker that was killed
            except (OSError, EOFError) as error:
                _log.warning("another worker's fixes cannot be received: %s", error)
            else:
                self._connections[path] = asyncio.create_task(self._hear(reader, writer))

    def _disconnect(self) -> None:
        for task in self._connections.values():
            task.cancel()
        self._connections.clear()

    async def _hear(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass another worker's events on to the listeners."""
        with contextlib.closing(writer):
            while head := await reader.readline():
                table, target_id = json.loads(head)
                data = (await reader.readline()).rstrip(b"\n")
                self._feed.pass_on(table, target_id, data)

    async def _tell(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send another worker the events of this one."""
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        try:
            with contextlib.closing(writer), self._feed.subscribe(own=True) as subscription:
                writer.write(_GREETING)
                left = asyncio.ensure_future(reader.read())
                try:
                    while not (left.done() or subscription.closed):
                        await subscription.wait(_SCAN_SECONDS)
                        _, events = subscription.take()
                        writer.writelines(
                            b"%b\n%b\n" % (json.dumps([event.table, event.target_id]).encode(), event.data)
                            for event in events
                        )
                        await writer.drain()
                finally:
                    left.cancel()
        except (ConnectionError, asyncio.CancelledError):
            pass  # the other worker ended, or this one does
        finally:
            self._clients.discard(task)
