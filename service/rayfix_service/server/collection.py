"""Collecting reference cycles while no request is under way.

A collection of the oldest generation looks at every object that is left since the process became ready. With the
reports of a long batch among them that takes 45 to 140 ms, in which nothing else is answered. It therefore waits for a
moment without POST requests, when what is left is little. Younger generations take less than a millisecond, and
are collected at once.
"""

import asyncio
import gc
from collections.abc import Callable
from contextlib import suppress

from rayfix_service.http.telemetry.request_context import UnderWay

_REST_SECONDS = 1.0

_LATEST_SECONDS = 3600.0
"""Time without such a moment after which it is done nevertheless. The service's own work leaves no cycles."""

_NEVER = 1_000_000_000


async def collect_while_idle(
    under_way: UnderWay,
    *,
    rest_seconds: float = _REST_SECONDS,
    latest_seconds: float = _LATEST_SECONDS,
    collect: Callable[[], object] = gc.collect,
) -> None:
    """Exempt all that there is from collection, and collect the oldest generation in idle moments from now on.

    Parameters
    ----------
    under_way : UnderWay
    rest_seconds : float
        Between two collections at least.
    latest_seconds : float
        Between two collections at most.
    collect : callable
        Collects all generations.
    """
    collect()
    gc.freeze()
    young, middle, _ = gc.get_threshold()
    gc.set_threshold(young, middle, _NEVER)
    while True:
        await asyncio.sleep(rest_seconds)
        with suppress(TimeoutError):
            await asyncio.wait_for(under_way.until_none(), latest_seconds)
        if gc.get_count()[2]:  # nothing has grown old since the last one otherwise
            collect()
