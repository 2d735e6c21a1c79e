"""Which closed parts are the building, inside of which everything is, and which are solids, in which nothing can be."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.solids import Part, is_inside, touched


@dataclass(frozen=True, kw_only=True)
class Enclosures:
    """What the closed parts of a scene are.

    Attributes
    ----------
    enclosing : ndarray of bool, shape (n_parts,)
        The part is a building, or the inner or outer face of its walls; every other closed part is a solid.
    rooms : ndarray of bool, shape (n_parts,)
        The innermost of them: free space is inside one of these.
    inside : ndarray of bool, shape (n_parts, n_stations)
        The station is in the closed part, or on its surface.
    """

    enclosing: NDArray[np.bool_]
    rooms: NDArray[np.bool_]
    inside: NDArray[np.bool_]


def find_enclosures(
    scene: Scene, parts: Sequence[Part], stations: NDArray[np.float64], settings: TwinSettings | None = None
) -> Enclosures:
    """Tell buildings from solids.

    A closed part with a station in it is a building or a solid that the station was misplaced into. What lies in such
    parts and what lies beside them decides: stations, and closed parts without any.

    - A part in no other is a building if it is large, and holds most stations, or more lies in such parts than beside
      them, or its triangles face inwards.
    - A part in another is the inner face of walls, or one room of several, if more lies in such parts than beside them,
      and they fill most of the outer one, or something is in it.

    Parameters
    ----------
    stations : ndarray of shape (n_stations, 3), m
    settings : TwinSettings, optional
    """
    settings = settings or TwinSettings()
    touch = settings.touch
    inside = _stations_inside(scene, parts, stations, touch)
    candidates = [i for i in range(len(parts)) if inside[i].any()]
    boxes = np.array([_box(scene, part) for part in parts])
    contents = _contents(scene, parts, candidates, boxes, settings.max_parts)
    outer = {i: _container(i, candidates, parts, inside, boxes, touch) for i in candidates}
    enclosing = np.zeros(len(parts), bool)
    extent = np.maximum(scene.bounds[1] - scene.bounds[0], 1e-9)
    for i in candidates:
        within = [k for k in candidates if outer[k] == outer[i]]
        if outer[i] < 0:
            stations_around, parts_around = np.ones(len(stations), bool), np.ones(contents.shape[1], bool)
            size = float(np.prod(extent))
        else:
            stations_around, parts_around = inside[outer[i]], contents[candidates.index(outer[i])]
            size = abs(parts[outer[i]].volume)
        rows = [candidates.index(k) for k in within]
        loose_stations = stations_around & ~inside[within].any(axis=0)
        loose_parts = parts_around & ~contents[rows].any(axis=0)
        held = int(inside[within].any(axis=0).sum()) + int(contents[rows].any(axis=0).sum())
        more = held > int(loose_stations.sum()) + int(loose_parts.sum())
        if outer[i] < 0:
            inwards = parts[i].consistent and parts[i].volume < 0.0
            enclosing[i] = abs(parts[i].volume) > settings.building_fraction * size and (
                inside[i].mean() > 0.5 or more or inwards
            )
        else:
            filled = sum(abs(parts[k].volume) for k in within) > settings.inner_fraction * size
            enclosing[i] = more and (filled or bool(contents[candidates.index(i)].any()))
    rooms = enclosing.copy()
    for i in candidates:
        if enclosing[i] and outer[i] >= 0:
            rooms[outer[i]] = False
    return Enclosures(enclosing=enclosing, rooms=rooms, inside=inside)


def _stations_inside(
    scene: Scene, parts: Sequence[Part], stations: NDArray[np.float64], touch: float
) -> NDArray[np.bool_]:
    inside = np.zeros((len(parts), len(stations)), bool)
    for i, part in enumerate(parts):
        if part.closed:
            triangles = scene.triangles[part.faces]
            low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
            for s in np.flatnonzero(np.all((stations >= low - touch) & (stations <= high + touch), axis=1)):
                inside[i, s] = is_inside(triangles, stations[s]) or touched(triangles, stations[s], touch=touch) >= 0
    return inside


def _box(scene: Scene, part: Part) -> NDArray[np.float64]:
    corners = scene.triangles[part.faces].reshape(-1, 3)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _container(
    i: int,
    candidates: list[int],
    parts: Sequence[Part],
    inside: NDArray[np.bool_],
    boxes: NDArray[np.float64],
    touch: float,
) -> int:
    """Smallest part with stations that part i lies in, -1 for none."""
    around = [
        j
        for j in candidates
        if abs(parts[j].volume) > abs(parts[i].volume)
        and np.all(inside[j] | ~inside[i])
        and np.all(boxes[j, 0] <= boxes[i, 0] + touch)
        and np.all(boxes[j, 1] >= boxes[i, 1] - touch)
    ]
    return min(around, key=lambda j: abs(parts[j].volume), default=-1)


def _contents(
    scene: Scene, parts: Sequence[Part], candidates: list[int], boxes: NDArray[np.float64], max_parts: int
) -> NDArray[np.bool_]:
    """Which closed parts without stations lie in the candidates, shape (n_candidates, n_looked_at)."""
    others = [i for i, part in enumerate(parts) if part.closed and i not in set(candidates)]
    looked_at = others[:: max(1, -(-len(others) // max_parts))]
    out = np.zeros((len(candidates), len(looked_at)), bool)
    middles = np.array([scene.triangles[parts[k].faces].mean(axis=(0, 1)) for k in looked_at]).reshape(-1, 3)
    for n, i in enumerate(candidates):
        triangles = scene.triangles[parts[i].faces]
        for m in np.flatnonzero(np.all((middles > boxes[i, 0]) & (middles < boxes[i, 1]), axis=1)):
            out[n, m] = is_inside(triangles, middles[m])
    return out
