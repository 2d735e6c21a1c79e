"""Collecting reference cycles while no request is under way.

A collection of the oldest generation looks at every object that is left since the process became ready. With the
reports of a long batch among them that takes up to 45 ms, in which nothing else is answered. It therefore waits for a
moment without POST requests, when what is left is little. Younger generations take less than a millisecond, and
are collected at once.
"""

import asyncio
import gc
from collections.abc import Callable
from time import monotonic

from rayfix_service.http.telemetry.request_context import UnderWay

_LOOK_SECONDS = 1.0

_LATEST_SECONDS = 600.0
"""Time without such a moment after which it is done nevertheless."""

_NEVER = 1_000_000_000


async def collect_while_idle(
    under_way: UnderWay,
    *,
    look_seconds: float = _LOOK_SECONDS,
    latest_seconds: float = _LATEST_SECONDS,
    collect: Callable[[], object] = gc.collect,
) -> None:
    """Exempt all that there is from collection, and collect the oldest generation in idle moments from now on.

    Parameters
    ----------
    under_way : UnderWay
    look_seconds : float
        Between two looks at it.
    latest_seconds : float
        Between two collections at most.
    collect : callable
        Collects all generations.
    """
    collect()
    gc.freeze()
    young, middle, _ = gc.get_threshold()
    gc.set_threshold(young, middle, _NEVER)
    last = monotonic()
    while True:
        await asyncio.sleep(look_seconds)
        is_due = not under_way.count or monotonic() - last > latest_seconds
        if is_due and gc.get_count()[2]:  # nothing has grown old since the last one otherwise
            collect()
            last = monotonic()
