"""Paths of stations under rules other than the table's: worked out once, and kept as long as they are used."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from rayfix_service.fusion.quadrature.blocks import BlockPaths, BlockTree, StationPaths
from rayfix_service.fusion.quadrature.selection import detected_paths, selected_paths
from rayfix_service.fusion.quadrature.spread import spread_paths
from rayfix_tables.paths import PathMap
from rayfix_tables.site import Selection


class Reweighted:
    """Weights of stations and rules, those used last.

    Parameters
    ----------
    most : int
        Weights of single stations that are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: OrderedDict[Any, StationPaths] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return how many are kept."""
        return len(self._kept)

    def has_selected(self, name: str, selection: Selection) -> bool:
        """Whether the weights of a station and rule are there."""
        return (name, selection) in self._kept

    def has_detected(self, name: str, within_db: float) -> bool:
        """Whether a station's probabilities of detection are there."""
        return (name, within_db) in self._kept

    def selected(self, name: str, paths: PathMap, tree: BlockTree, selection: Selection) -> StationPaths:
        """Paths of a station by their probability to be the one that it reports."""
        return self._found((name, selection), paths, tree, lambda wide: selected_paths(wide, selection))

    def detected(self, name: str, paths: PathMap, tree: BlockTree, within_db: float) -> StationPaths:
        """Paths of a station by their probabilities to be reported, where it reports all."""
        return self._found((name, within_db), paths, tree, lambda wide: detected_paths(wide, within_db))

    def _found(self, key: Any, paths: PathMap, tree: BlockTree, weigh: Callable[[PathMap], BlockPaths]) -> StationPaths:
        with self._lock:
            found = self._kept.get(key)
            if found is not None:
                self._kept.move_to_end(key)
                return found
        # Two threads may both work it out, which is better than that all wait.
        found = StationPaths(paths, tree, weigh(spread_paths(paths)))
        with self._lock:
            self._kept[key] = found
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return found
