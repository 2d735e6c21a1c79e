"""Buildings and solids: halls side by side, walls of two faces, rooms in a shell, and stations where none can be."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from rayfix_offline.twin.enclosures import find_enclosures
from rayfix_offline.twin.mesh import Mesh
from rayfix_offline.twin.solids import split_parts
from tests.support.scenes.rooms import scene_of, twin_of
from tests.support.scenes.shapes import box

WriteSite = Callable[..., Path]
Point = tuple[float, float, float]


def kinds(objects: dict[str, NDArray[np.float64]], *stations: Point) -> dict[str, str]:
    """Say of each object whether it is a room, a shell around rooms, or a solid."""
    scene = scene_of(**objects)
    parts = split_parts(Mesh(scene=scene))
    found = find_enclosures(scene, parts, np.array(stations))
    return {
        part.name: "room" if room else "shell" if encloses else "solid"
        for part, encloses, room in zip(parts, found.enclosing, found.rooms, strict=True)
    }


def test_two_halls_with_half_of_the_stations_each() -> None:
    halls = {"a": box((0, 0, 0), (10, 10, 4)), "b": box((20, 0, 0), (30, 10, 4)), "crate": box((3, 3, 0), (4, 4, 1))}
    expected = {"a": "room", "b": "room", "crate": "solid"}
    assert kinds(halls, (1, 1, 3), (21, 1, 3)) == expected
    assert kinds(halls, (1, 1, 3), (21, 1, 3), (2, 8, 3), (29, 8, 3)) == expected


def test_three_halls() -> None:
    halls = {name: box((20 * n, 0, 0), (20 * n + 10, 10, 4)) for n, name in enumerate("abc")}
    assert kinds(halls, (1, 1, 3), (21, 1, 3), (41, 1, 3)) == dict.fromkeys("abc", "room")


def test_a_lone_station_in_a_large_solid() -> None:
    """The machine takes up 48 of 120 m3, but crates stand beside it."""
    room = {"room": box((0, 0, 0), (6, 5, 4)), "machine": box((1, 1, 0), (5, 5, 3))}
    crates = {f"crate {n}": box((0.2, 0.2 + n, 0), (0.6, 0.6 + n, 1)) for n in range(3)}
    solid = dict.fromkeys(["machine", *crates], "solid")
    assert kinds({**room, **crates}, (2, 2, 1)) == {"room": "room", **solid}
    # Even in an otherwise empty room: inner faces of walls would fill more of it.
    assert kinds(room, (2, 2, 1)) == {"room": "room", "machine": "solid"}


def test_walls_with_two_faces_around_two_rooms() -> None:
    flat = {"shell": box((-0.3, -0.3, -0.3), (10.3, 5.3, 3.3))}
    rooms = {"left": box((0, 0, 0), (4.9, 5, 3)), "right": box((5.1, 0, 0), (10, 5, 3))}
    crate = {"crate": box((1, 1, 0), (2, 2, 1))}
    expected = {"shell": "shell", "left": "room", "right": "room", "crate": "solid"}
    assert kinds({**flat, **rooms, **crate}, (0.5, 0.5, 2), (9, 4, 2)) == expected
    # A room in which no station is cannot be told from a pillar, and nothing is ever located there.
    assert kinds({**flat, **rooms, **crate}, (0.5, 0.5, 2), (0.5, 4.5, 2))["right"] == "solid"


def test_a_station_in_a_rack_of_an_open_yard() -> None:
    """Without a building: the other stations are in no closed part at all."""
    yard = {"rack": box((0, 0, 0), (8, 2, 4)), "shed": box((0, 8, 0), (8, 10, 4))}
    assert kinds(yard, (1, 1, 1), (4, 5, 3), (5, 5, 3)) == {"rack": "solid", "shed": "solid"}


def test_the_free_space_of_two_halls(tmp_path: Path, write_site: WriteSite) -> None:
    scene = trimesh.Scene()
    for n, name in enumerate("ab"):
        mesh = trimesh.creation.box(bounds=[(10 * n, 0, 0), (10 * n + 5, 4, 3)])
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    sites = [{"id": f"bs{n}", "position_m": [10 * n + 1, 1, 2.5]} for n in range(2)]
    twin = twin_of(write_site(tmp_path, scene=scene, stations=sites))
    assert twin.findings == ()
    assert twin.closed
    assert twin.free_space.volume == pytest.approx(2 * 5 * 4 * 3, rel=1e-9)
    between = [*sites, {"id": "bs2", "position_m": [7, 2, 1]}]
    (finding,) = twin_of(write_site(tmp_path, scene=scene, stations=between)).findings
    assert finding.problem.startswith("station 'bs2' at (7, 2, 1) m lies outside or in the wall of '")
    assert finding.station_id == "bs2"


@pytest.mark.parametrize("roof", [True, False])
def test_walls_that_are_solids_seal_the_free_space(tmp_path: Path, write_site: WriteSite, roof: bool) -> None:
    """An L of walls 0.2 m thick, as architects' models have them; outside the L is not free, unless its roof is off.

    ::

        y = 8 +-----+
              |     |
              |     |     outside
        y = 4 |     +-----+
              |           |
        y = 0 +-----------+
              0     4     8
    """
    walls = [
        ((-0.2, -0.2), (8.2, 0.0)),
        ((-0.2, 0.0), (0.0, 8.2)),
        ((0.0, 8.0), (4.2, 8.2)),
        ((4.0, 4.0), (4.2, 8.0)),
        ((4.2, 4.0), (8.2, 4.2)),
        ((8.0, 0.0), (8.2, 4.0)),
    ]
    slabs = [((-0.2, -0.2, -0.2), (8.2, 8.2, 0.0)), ((-0.2, -0.2, 3.0), (8.2, 8.2, 3.2))]
    boxes = [((*low, 0.0), (*high, 3.0)) for low, high in walls] + (slabs if roof else slabs[:1])
    scene = trimesh.Scene()
    for n, bounds in enumerate(boxes):
        scene.add_geometry(trimesh.creation.box(bounds=bounds), geom_name=f"wall {n}", node_name=f"wall {n}")
    twin = twin_of(write_site(tmp_path, scene=scene, stations=[{"id": "bs1", "position_m": [0.5, 0.5, 2.5]}]))
    assert twin.findings == ()
    assert twin.closed is roof
    inside, outside = np.array([(2.0, 7.0, 1.0), (7.0, 2.0, 1.0)]), np.array((6.5, 6.5, 1.0))
    assert twin.free_space.contains(inside).all()
    assert bool(twin.free_space.contains(outside)) is not roof
    if roof:
        assert twin.free_space.volume == pytest.approx((8 * 8 - 4 * 4) * 3, rel=0.02)
