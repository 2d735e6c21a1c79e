"""Results that follow from a table alone and are worth keeping while it is served."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

T = TypeVar("T")


class TableCache:
    """Keeps what is computed of tables, the latest ones, by ``table_id`` and a name.

    Parameters
    ----------
    most : int
        Results that are kept.
    """

    def __init__(self, most: int = 64) -> None:
        self._most = most
        self._kept: dict[tuple[str, str], Any] = {}
        self._under_way: dict[tuple[str, str], asyncio.Task[Any]] = {}

    async def get(
        self,
        table_id: str,
        name: str,
        compute: Callable[[], T],
        run: Callable[[Callable[[], T]], Awaitable[T]] = asyncio.to_thread,
    ) -> T:
        """Return a result, computed by ``run`` for the first request; requests meanwhile wait for the same result.

        A failure is raised to all that wait, and not kept. A request that is cancelled leaves the work to the others.
        """
        key = (table_id, name)
        if key in self._kept:
            kept: T = self._kept[key]
            return kept
        task: asyncio.Task[T] | None = self._under_way.get(key)
        if task is None:
            task = asyncio.ensure_future(self._compute(key, compute, run))
            task.add_done_callback(lambda done: self._end(key, done))
            self._under_way[key] = task
        return await asyncio.shield(task)

    async def _compute(
        self, key: tuple[str, str], compute: Callable[[], T], run: Callable[[Callable[[], T]], Awaitable[T]]
    ) -> T:
        result = await run(compute)
        while len(self._kept) >= self._most:
            self._kept.pop(next(iter(self._kept)))
        self._kept[key] = result
        return result

    def _end(self, key: tuple[str, str], done: asyncio.Task[Any]) -> None:
        del self._under_way[key]
        if not done.cancelled():
            done.exception()  # retrieved even if nobody waits any longer
