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

    async def get(
        self,
        table_id: str,
        name: str,
        compute: Callable[[], T],
        run: Callable[[Callable[[], T]], Awaitable[T]] = asyncio.to_thread,
    ) -> T:
        """Return a result, computed by ``run`` the first time, in a thread unless told otherwise."""
        key = (table_id, name)
        if key not in self._kept:
            result = await run(compute)
            while len(self._kept) >= self._most:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = result
        kept: T = self._kept[key]
        return kept
