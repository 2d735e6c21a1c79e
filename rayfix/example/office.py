"""The second bundled example: an office whose partitions let signals through.

The office measures 20 x 14 x 2.8 m: seven rooms on both sides of a corridor, with open doors::

    y = 14 +--======--+--====--+-=====--+      # concrete   = window   - plasterboard   : glass
           | meeting  |        |        |
           |    o     |        |   o    |      o station
    y =  8 :::::  ::::-  ------+-----  --
                     o corridor
    y =  6 -  ---+-  ----+-  ---+-  ----
           |     |       |      |      |
           |   o |       |      |   o  |
    y =  0 +-===-+--===--+-===--+--===-+
         x = 0   5      10     15      20

Walls, panes, doors and table tops are sheets; site.toml states their thickness. Cabinets are closed metal boxes. The
shell is closed by itself: partitions stand a few millimetres off it.
"""

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import trimesh

OFFICE_SIZE = (20.0, 14.0, 2.8)
"""Length of the office along x, y and z, m."""

GAP = 0.005
"""Distance of partitions from the shell, m."""

DOOR_WIDTH, DOOR_HEIGHT = 0.9, 2.1
"""m."""

SILL, HEAD = 0.9, 2.2
"""Lower and upper edge of the windows, m."""

_SOUTH, _NORTH = 6.0, 8.0
_SOUTH_WINDOWS = ((1.0, 4.0), (6.0, 9.0), (11.0, 14.0), (16.0, 19.0))
_NORTH_WINDOWS = ((1.0, 7.0), (9.0, 13.0), (15.0, 19.0))
_SOUTH_DOORS = (1.0, 6.0, 11.0, 16.0)

Rectangle = NDArray[np.float64]
"""Corners of a flat rectangle, in order, shape (4, 3), m."""


def office_stations() -> list[tuple[str, tuple[float, float, float]]]:
    """List identifiers and positions [m] of the five stations, which hang below the ceiling."""
    return [
        ("ap1", (3.2, 2.7, 2.6)),
        ("ap2", (17.3, 3.1, 2.6)),
        ("ap3", (10.4, 7.1, 2.6)),
        ("ap4", (3.7, 11.2, 2.6)),
        ("ap5", (16.8, 10.9, 2.6)),
    ]


def office_scene() -> "trimesh.Scene":
    """Make the office as a trimesh scene, one named geometry per object, metres, z up."""
    import trimesh
    from trimesh.visual.material import PBRMaterial

    colours = {
        "concrete": (176, 176, 170, 255),
        "glass": (150, 200, 215, 160),
        "metal": (108, 130, 150, 255),
        "plasterboard": (225, 222, 212, 255),
        "wood": (176, 138, 92, 255),
    }
    scene = trimesh.Scene()
    objects: list[tuple[str, str, trimesh.Trimesh]] = [
        (name, material, _mesh(rectangles)) for name, material, rectangles in (*_shell(), *_partitions(), *_tables())
    ]
    objects += [(name, "metal", trimesh.creation.box(bounds=corners)) for name, corners in _cabinets()]
    for name, material, mesh in objects:
        mesh.visual = trimesh.visual.TextureVisuals(
            material=PBRMaterial(name=f"itu_{material}", baseColorFactor=colours[material])
        )
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    return scene


def _mesh(rectangles: Iterable[Rectangle]) -> "trimesh.Trimesh":
    import trimesh

    corners = np.concatenate(list(rectangles))
    first = np.arange(0, len(corners), 4)[:, None]
    faces = np.concatenate([first + np.array(corner) for corner in ((0, 1, 2), (0, 2, 3))])
    mesh = trimesh.Trimesh(corners, faces, process=False)
    mesh.merge_vertices()
    return mesh


def _upright(axis: int, at: float, low: tuple[float, float], high: tuple[float, float]) -> Rectangle:
    """Rectangle at x or y = ``at`` (axis 0 or 1), between (along, z) = ``low`` and ``high``."""
    along = [low[0], high[0], high[0], low[0]]
    up = [low[1], low[1], high[1], high[1]]
    fixed = [at] * 4
    return np.array([fixed, along, up] if axis == 0 else [along, fixed, up]).T


def _level(z: float, low: tuple[float, float], high: tuple[float, float]) -> Rectangle:
    """Horizontal rectangle."""
    return np.array([(low[0], low[1], z), (high[0], low[1], z), (high[0], high[1], z), (low[0], high[1], z)])


def _shell() -> Iterable[tuple[str, str, list[Rectangle]]]:
    """Floor, ceiling, outer walls and windows, seen from inside; their edges meet, so that they close."""
    x, y, z = OFFICE_SIZE
    cuts = sorted({0.0, x, *(edge for window in (*_SOUTH_WINDOWS, *_NORTH_WINDOWS) for edge in window)})
    steps = list(pairwise(cuts))
    yield "floor", "concrete", [_level(0.0, (a, 0.0), (b, y)) for a, b in steps]
    yield "ceiling", "concrete", [_level(z, (a, 0.0), (b, y))[::-1] for a, b in steps]
    bands = ((0.0, SILL), (SILL, HEAD), (HEAD, z))
    walls = [_upright(0, 0.0, (0.0, low), (y, high)) for low, high in bands]
    walls += [_upright(0, x, (0.0, low), (y, high))[::-1] for low, high in bands]
    panes: list[Rectangle] = []
    for at, windows in ((0.0, _SOUTH_WINDOWS), (y, _NORTH_WINDOWS)):
        for a, b in steps:
            for low, high in bands:
                glazed = low == SILL and any(first <= a and b <= last for first, last in windows)
                rectangle = _upright(1, at, (a, low), (b, high))
                (panes if glazed else walls).append(rectangle if at else rectangle[::-1])
    yield "outer_walls", "concrete", walls
    yield "windows", "glass", panes


def _wall(at: float, first: float, last: float, doors: tuple[float, ...]) -> list[Rectangle]:
    """Partition at y = ``at`` with doorways that begin at the given x."""
    high = OFFICE_SIZE[2] - GAP
    edges = [first, *(edge for door in doors for edge in (door, door + DOOR_WIDTH)), last]
    pieces = [_upright(1, at, (a, GAP), (b, high)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return pieces + [_upright(1, at, (door, DOOR_HEIGHT), (door + DOOR_WIDTH, high)) for door in doors]


def _partitions() -> Iterable[tuple[str, str, list[Rectangle]]]:
    """Inner walls, the glass front of the meeting room, and doors that stand open."""
    x, y, z = OFFICE_SIZE
    yield "wall_south", "plasterboard", _wall(_SOUTH, GAP, x - GAP, _SOUTH_DOORS)
    yield "wall_north", "plasterboard", _wall(_NORTH, 8.0, x - GAP, (9.0, 18.0))
    yield "glass_front", "glass", _wall(_NORTH, GAP, 8.0, (5.5,))
    for at in (5.0, 10.0, 15.0):
        yield f"wall_{at:g}_south", "plasterboard", [_upright(0, at, (GAP, GAP), (_SOUTH, z - GAP))]
    for at in (8.0, 14.0):
        yield f"wall_{at:g}_north", "plasterboard", [_upright(0, at, (_NORTH, GAP), (y - GAP, z - GAP))]
    doors = [(door, _SOUTH - DOOR_WIDTH, _SOUTH) for door in _SOUTH_DOORS]
    doors += [(door, _NORTH, _NORTH + DOOR_WIDTH) for door in (5.5, 9.0, 18.0)]
    for number, (hinge, low, high) in enumerate(doors, start=1):
        leaf = _upright(0, hinge - 0.01, (low + 0.02, GAP), (high - 0.02, DOOR_HEIGHT - 0.02))
        yield f"door_{number}", "glass" if hinge == 5.5 else "wood", [leaf]


def _tables() -> Iterable[tuple[str, str, list[Rectangle]]]:
    """Table tops."""
    desks = [(2.6, 1.0), (7.4, 0.8), (7.4, 3.2), (12.6, 1.0), (12.2, 3.4), (17.6, 1.2), (10.2, 12.6), (11.6, 9.6)]
    desks += [(15.2, 12.6), (17.4, 12.6), (15.2, 9.4)]
    for number, (a, b) in enumerate(desks, start=1):
        yield f"desk_{number}", "wood", [_level(0.74, (a, b), (a + 1.6, b + 0.8))]
    yield "meeting_table", "wood", [_level(0.74, (2.0, 10.2), (5.6, 11.6))]


def _cabinets() -> Iterable[tuple[str, list[tuple[float, float, float]]]]:
    """Opposite corners of closed metal cabinets and of two machines in the last room, m."""
    boxes = [
        (0.1, 2.0, 0.5, 4.4, 1.95),
        (5.1, 3.0, 5.55, 5.4, 1.95),
        (9.45, 0.6, 9.9, 2.6, 1.2),
        (14.4, 2.2, 14.9, 4.6, 1.95),
        (19.5, 1.0, 19.9, 3.4, 1.95),
        (0.15, 12.8, 0.65, 13.8, 1.3),
        (8.15, 10.6, 8.6, 13.0, 1.95),
        (13.4, 11.0, 13.9, 13.4, 1.95),
        (19.3, 11.0, 19.9, 12.4, 1.8),
        (19.3, 9.2, 19.9, 9.9, 1.0),
    ]
    for number, (x0, y0, x1, y1, height) in enumerate(boxes, start=1):
        yield f"cabinet_{number}", [(x0, y0, 0.001), (x1, y1, height)]
