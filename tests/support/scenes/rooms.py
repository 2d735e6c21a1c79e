"""The room of 4 x 5 x 3 m that tests of the builder trace, and how they trace it.

::

    y = 5 +-----------------+
          |          +---+  |      table top, z from 0.9 to 1.1
          |          |   |  |
          |          +---+  |
          |   +--+          |
          |   |  |          |      cabinet, z from 0.0 to 1.8
          |   +--+          |
    y = 0 +-----------------+
        x = 0               4
"""

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from rayfix_offline.rays.trace import LevelRays, trace_station
from rayfix_offline.scene.scene import Scene
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import Twin, prepare_twin

ROOM = ((0.0, 0.0, 0.0), (4.0, 5.0, 3.0))
CABINET = ((0.5, 1.0, 0.0), (1.3, 2.2, 1.8))
TABLE = ((2.4, 2.8, 0.9), (3.4, 4.1, 1.1))


def scene_of(**objects: NDArray[np.float64]) -> Scene:
    """Scene of named triangles of shape (n, 3, 3), m, without materials; each triangle has vertices of its own."""
    triangles = np.concatenate(list(objects.values()))
    return Scene(
        vertices=triangles.reshape(-1, 3),
        faces=np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3),
        face_materials=np.full(len(triangles), -1, np.int16),
        materials=(),
        face_objects=np.repeat(np.arange(len(objects)), [len(t) for t in objects.values()]).astype(np.int32),
        objects=tuple(objects),
    )


def scene_of_boxes(**bounds: ArrayLike) -> trimesh.Scene:
    """Scene of named axis-aligned boxes, each given by its two corners, m."""
    scene = trimesh.Scene()
    for name, corners in bounds.items():
        scene.add_geometry(trimesh.creation.box(bounds=corners), geom_name=name, node_name=name)
    return scene


def room_with_crate(height: float = 1.0) -> trimesh.Trimesh:
    """Mesh of the room, whose triangles face inwards, with a crate of 1 x 1 m that hangs 0.2 m above the floor."""
    room = trimesh.creation.box(bounds=ROOM)
    room.invert()
    crate = trimesh.creation.box(bounds=[(1.5, 2.0, 0.2), (2.5, 3.0, 0.2 + height)])
    return trimesh.util.concatenate([room, crate])


def finest_level(folder: Path, scene: trimesh.Scene, site: SiteFile) -> LevelRays:
    """Write a scene where the site looks for it, and trace the site's first station."""
    assert site.site.scene is not None
    (folder / site.site.scene).write_bytes(scene.export(file_type="glb"))
    return trace_station(site.stations[0], site, prepare_twin(site, folder)).finest


def twin_of(path: Path) -> Twin:
    """Prepare the twin of a site file."""
    return prepare_twin(read_site(path), path.parent)
