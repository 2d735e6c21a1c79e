"""Results that follow from a table alone and are worth keeping while it is served."""

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


class PerTable:
    """Keeps what is computed of tables, the latest ones, by ``table_id`` and a name.

    Parameters
    ----------
    most : int
        Results that are kept.
    """

    def __init__(self, most: int = 64) -> None:
        self._most = most
        self._kept: dict[tuple[str, str], Any] = {}

    async def get(self, table_id: str, name: str, compute: Callable[[], T]) -> T:
        """Return a result, computed in a thread the first time."""
        key = (table_id, name)
        if key not in self._kept:
            result = await asyncio.to_thread(compute)
            while len(self._kept) >= self._most:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = result
        kept: T = self._kept[key]
        return kept
