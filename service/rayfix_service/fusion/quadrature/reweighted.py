"""Paths of stations under rules other than the table's: worked out once, and kept as long as they are used."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar

from rayfix_service.fusion.quadrature.blocks import BlockTree, StationPaths
from rayfix_service.fusion.quadrature.detection import DetectedPaths, station_detection
from rayfix_service.fusion.quadrature.selection import selected_paths
from rayfix_service.fusion.quadrature.spread import spread_paths
from rayfix_tables.paths import PathMap
from rayfix_tables.site import Selection

_Found = TypeVar("_Found", StationPaths, DetectedPaths)


class Reweighted:
    """Weights of stations and rules, those used last.

    Parameters
    ----------
    most : int
        Weights of single stations that are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: OrderedDict[Any, Any] = OrderedDict()
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
        return self._found(
            (name, selection), lambda: StationPaths(paths, tree, selected_paths(spread_paths(paths), selection))
        )

    def detected(self, name: str, paths: PathMap, tree: BlockTree, within_db: float) -> DetectedPaths:
        """Paths of a station by their probabilities to be reported, where it reports all."""
        return self._found((name, within_db), lambda: station_detection(paths, tree, within_db))

    def _found(self, key: Any, work_out: Callable[[], _Found]) -> _Found:
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                kept: _Found = self._kept[key]
                return kept
        # Two threads may both work it out, which is better than that all wait.
        found = work_out()
        with self._lock:
            self._kept[key] = found
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return found
