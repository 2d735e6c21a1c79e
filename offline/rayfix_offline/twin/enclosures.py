"""Closed parts: buildings, which contain the free space, and solids, which do not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.scene import Scene
from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.solids import Part, is_inside, touched


@dataclass(frozen=True, kw_only=True)
class Enclosures:
    """Classification of the parts of a scene.

    Attributes
    ----------
    enclosing : ndarray of bool, shape (n_parts,)
        The part is a building, or the inner or outer face of its walls. Every other closed part is a solid.
    rooms : ndarray of bool, shape (n_parts,)
        The innermost of these; free space lies inside one of them.
    inside : ndarray of bool, shape (n_parts, n_stations)
        The station is inside the closed part or on its surface.
    """

    enclosing: NDArray[np.bool_]
    rooms: NDArray[np.bool_]
    inside: NDArray[np.bool_]


def find_enclosures(
    scene: Scene, parts: Sequence[Part], stations: NDArray[np.float64], settings: TwinSettings | None = None
) -> Enclosures:
    """Distinguish buildings from solids.

    A closed part that contains a station is a building, or a solid with a misplaced station. The objects inside and
    outside of such parts decide; objects are stations, and closed parts without a station.

    - An outermost part is a building if it is large and one of these holds: it contains most stations; more objects lie
      inside of such parts than outside; its triangles face inwards.
    - A part inside another is the inner face of walls, or one room of several, if more objects lie inside of such parts
      than outside, and either they fill most of the outer part or the part contains an object.

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
    """Smallest part with stations that contains part i, -1 for none."""
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
    """Which closed parts without stations lie inside the candidates, shape (n_candidates, n_sampled)."""
    others = [i for i, part in enumerate(parts) if part.closed and i not in set(candidates)]
    sampled = others[:: max(1, -(-len(others) // max_parts))]
    out = np.zeros((len(candidates), len(sampled)), bool)
    middles = np.array([scene.triangles[parts[k].faces].mean(axis=(0, 1)) for k in sampled]).reshape(-1, 3)
    for n, i in enumerate(candidates):
        triangles = scene.triangles[parts[i].faces]
        for m in np.flatnonzero(np.all((middles > boxes[i, 0]) & (middles < boxes[i, 1]), axis=1)):
            out[n, m] = is_inside(triangles, middles[m])
    return out
