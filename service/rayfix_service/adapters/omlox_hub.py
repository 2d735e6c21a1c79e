"""Sending positions to an omlox hub (omlox Hub API, version 2: ``PUT /providers/{provider_id}/location``).

Locations are queued in lanes. A lane sends one at a time, and all locations of a target use the same lane, which keeps
them in order. Only the lanes wait for the hub. If it is slow or down, the oldest locations are dropped.
"""

import asyncio
import logging
import zlib
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Literal
from urllib.parse import urlsplit

import httpx

from rayfix_service.adapters.omlox import fix_to_omlox
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.tracking.track import TrackedPosition
from rayfix_service.wire.names import in_log, path_segment
from rayfix_tables.errors import RayfixError, ReportError
from rayfix_tables.site import SiteInfo

_log = logging.getLogger(__name__)

HubOutcome = Literal["sent", "refused", "dropped"]
"""Outcome of a location: accepted or refused by the hub, or dropped because the queue was full or time ran out."""

_PASSING = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Statuses after which the hub may accept the same location later."""


class HubError(RayfixError):
    """The hub's address cannot be used."""


@dataclass(frozen=True, kw_only=True)
class HubSettings:
    """Address of the hub, and how long sending is attempted.

    Attributes
    ----------
    url : str
        Address of its API, such as ``http://hub:8081/v2``.
    token : str or None
        Sent as ``Authorization: Bearer``.
    lanes : int
        Locations that are sent at the same time.
    capacity : int
        Locations that wait in each lane.
    attempts : int
        Largest number of attempts for a location.
    first_pause, longest_pause : float, s
        Pause before the second attempt, and the longest pause; each is twice as long as the one before.
    timeout : float, s
        From the start of an attempt to the end of the hub's answer, even if the hub sends it slowly.
    answer_bytes : int
        Bytes of an answer that are read, to keep the connection usable. They are not evaluated.
    """

    url: str
    token: str | None = field(default=None, repr=False)
    lanes: int = 4
    capacity: int = 256
    attempts: int = 5
    first_pause: float = 0.25
    longest_pause: float = 5.0
    timeout: float = 5.0
    answer_bytes: int = 4096

    def __post_init__(self) -> None:
        """Check the address."""
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.netloc or parts.query or parts.fragment:
            raise HubError(f"omlox hub {self.url!r} is not an address; give that of its API, e.g. http://hub:8081/v2")


class OmloxHub:
    """Sends locations to a hub in the background, within one event loop; see :func:`open_hub`.

    Parameters
    ----------
    settings : HubSettings
    on_outcome : callable, optional
        Called with the outcome of each location.
    """

    def __init__(self, settings: HubSettings, *, on_outcome: Callable[[HubOutcome], None] | None = None) -> None:
        self._settings = settings
        self._on_outcome = on_outcome or (lambda outcome: None)
        self._lanes = [_Lane() for _ in range(settings.lanes)]
        self._failing = False

    def tell(self, fix: Fix, site: SiteInfo, track: TrackedPosition | None = None) -> None:
        """Queue the position of a track, or of a fix without one, if there is a position; returns at once."""
        if track is not None or (fix.candidates and fix.regions is not None):
            self.put(fix_to_omlox(fix, site, track))

    def put(self, location: dict[str, Any]) -> None:
        """Queue a location and return at once."""
        lane = self._lanes[zlib.crc32(location["provider_id"].encode("utf-8", "surrogatepass")) % len(self._lanes)]
        if len(lane.waiting) == self._settings.capacity:
            lane.waiting.popleft()
            self._on_outcome("dropped")
        lane.waiting.append(location)
        lane.filled.set()

    @property
    def num_waiting(self) -> int:
        """Number of locations that are queued or being sent."""
        return sum(len(lane.waiting) + lane.sending for lane in self._lanes)

    async def run(self) -> None:
        """Send until cancelled."""
        headers = {"accept-encoding": "identity"}
        if self._settings.token is not None:
            headers["authorization"] = f"Bearer {self._settings.token}"
        async with (
            httpx.AsyncClient(headers=headers, timeout=self._settings.timeout) as client,
            asyncio.TaskGroup() as group,
        ):
            for lane in self._lanes:
                group.create_task(self._run_lane(client, lane))

    async def _run_lane(self, client: httpx.AsyncClient, lane: "_Lane") -> None:
        while True:
            await lane.filled.wait()
            while lane.waiting:
                lane.sending = True
                outcome: HubOutcome = "dropped"
                try:
                    outcome = await self._send(client, lane.waiting.popleft())
                except Exception:
                    # A defect with one location must not end its lane.
                    _log.exception("a location could not be sent")
                lane.sending = False
                self._on_outcome(outcome)
            lane.filled.clear()

    async def _send(self, client: httpx.AsyncClient, location: dict[str, Any]) -> HubOutcome:
        settings = self._settings
        try:
            url = f"{settings.url.rstrip('/')}/providers/{path_segment(location['provider_id'])}/location"
        except ReportError as error:
            _log.warning("a position is not sent to the omlox hub: %s", error)
            return "refused"
        pause = settings.first_pause
        for attempt in range(1, settings.attempts + 1):
            try:
                status = await self._put(client, url, location)
            except TimeoutError:
                reason = f"no answer within {settings.timeout:g} s"
            except httpx.HTTPError as error:
                reason = in_log(str(error), most=1000) or type(error).__name__
            else:
                if 200 <= status < 300:
                    self._tell_once(failing=False, reason="")
                    return "sent"
                reason = f"status {status}"
                if status not in _PASSING:
                    self._tell_once(failing=True, reason=reason)
                    return "refused"
            self._tell_once(failing=True, reason=reason)
            if attempt < settings.attempts:
                await asyncio.sleep(pause)
                pause = min(2.0 * pause, settings.longest_pause)
        return "dropped"

    async def _put(self, client: httpx.AsyncClient, url: str, location: dict[str, Any]) -> int:
        """Make one attempt and return the status. It is valid even if the rest of the answer is long or missing.

        Raises
        ------
        TimeoutError, httpx.HTTPError
            When no status arrives in time.
        """
        status = None
        try:
            async with (
                asyncio.timeout(self._settings.timeout),
                client.stream("PUT", url, json=location) as answer,  # left early, it closes the connection
            ):
                status, length = answer.status_code, 0
                async for part in answer.aiter_raw():
                    length += len(part)
                    if length > self._settings.answer_bytes:
                        break
        except (TimeoutError, httpx.HTTPError):
            if status is None:
                raise
        return status

    def _tell_once(self, *, failing: bool, reason: str) -> None:
        """Log the first of several failures in a row, and the first success after them."""
        if failing and not self._failing:
            _log.warning("the omlox hub %s does not take positions: %s", self._settings.url, reason)
        elif self._failing and not failing:
            _log.info("the omlox hub %s takes positions again", self._settings.url)
        self._failing = failing


@dataclass
class _Lane:
    """Queued locations in order, and whether one is being sent."""

    waiting: deque[dict[str, Any]] = field(default_factory=deque)
    filled: asyncio.Event = field(default_factory=asyncio.Event)
    sending: bool = False


@asynccontextmanager
async def open_hub(
    settings: HubSettings | None,
    *,
    on_outcome: Callable[[HubOutcome], None] | None = None,
    cooperation: float = 2.0,
) -> AsyncIterator[OmloxHub | None]:
    """Send in the background inside the context; on exit, send the queued locations for up to `patience` seconds.

    Yields None without settings.
    """
    if settings is None:
        yield None
        return
    hub = OmloxHub(settings, on_outcome=on_outcome)
    work = asyncio.create_task(hub.run())
    try:
        yield hub
    finally:
        with suppress(TimeoutError):
            async with asyncio.timeout(cooperation):
                while hub.num_waiting:
                    await asyncio.sleep(0.01)
        work.cancel()
        with suppress(asyncio.CancelledError):
            await work
