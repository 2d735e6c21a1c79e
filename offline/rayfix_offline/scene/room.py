"""An empty room as a scene, from its size and materials."""

from pathlib import Path

import numpy as np

from rayfix_offline.scene.placed import Placed, Remark, one_material
from rayfix_offline.scene.scene import Scene, scene_of
from rayfix_offline.site import OFF_WALL, SiteFile
from rayfix_offline.site_sections import RoomSection

_SIDES = {
    "floor": ((0, 2, 3, 1),),
    "ceiling": ((4, 5, 7, 6),),
    "walls": ((0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6)),
}
"""Corners of each side; corner 4 k + 2 j + i is at x, y, z of i, j, k. Normals point inwards, as a room's do."""


def room_scene(room: RoomSection) -> Scene:
    """Make the scene of an empty room."""
    corners = np.array([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)]) * room.size_m
    objects = []
    for name, sides in _SIDES.items():
        faces = np.array([triangle for a, b, c, d in sides for triangle in ((a, c, b), (a, d, c))])
        materials, face_materials = one_material(getattr(room, name), len(faces))
        objects.append(
            Placed(name=name, vertices=corners, faces=faces, materials=materials, face_materials=face_materials)
        )
    return scene_of(Path("[room]"), objects)


def wall_remarks(site: SiteFile) -> tuple[Remark, ...]:
    """Say which stations of a room stand on its walls."""
    if site.room is None:
        return ()
    size = np.asarray(site.room.size_m)
    on_walls = []
    for station in site.stations:
        position = np.asarray(station.position_m)
        if np.any(np.abs(np.minimum(position, size - position) - OFF_WALL) < 1e-6):
            on_walls.append(station.id)
    if not on_walls:
        return ()
    problem = f"{', '.join(on_walls)}: on a wall of the room, moved off it by {1e3 * OFF_WALL:g} mm"
    return (
        Remark(
            kind="on a wall",
            problem=problem,
            remedy="where a millimetre counts, state the positions of the antennas themselves",
        ),
    )
