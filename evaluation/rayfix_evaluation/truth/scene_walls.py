"""What the walls of a table's scene are made of, as rays and the forward solver take it.

Only the materials come from the software that builds tables: permittivities, thicknesses, constant losses, and which
triangles enclose a solid. What these do to a path is the forward solver's own.
"""

import numpy as np

from rayfix_evaluation.truth.walls import Walls
from rayfix_offline.rays.trace import scene_walls
from rayfix_offline.scene.scene import Scene
from rayfix_offline.scene.walls import Walls as SceneWalls
from rayfix_offline.scene.walls import opaque_walls, walls_of
from rayfix_offline.site import parse_site
from rayfix_offline.twin.twin import Twin, prepare_scene
from rayfix_tables.table import Table


def walls_of_table(table: Table) -> Walls | None:
    """Return the walls of a table's scene for the solver; None if all are opaque and reflect with one loss."""
    found = scene_walls_of_table(table)
    return None if found is None else _walls(found)


def scene_walls_of_table(table: Table) -> SceneWalls | None:
    """Return the walls of a table's scene for rays; None if all are opaque and reflect with one loss."""
    document = table.site.document
    if document["propagation"].get("reflection", "constant") == "constant" and not document.get("materials"):
        return None  # also of tables whose software knew no materials
    stored = table.scene.in_table_frame
    site = parse_site(document).moved(-table.scene.origin)
    count = len(stored.faces)
    scene = Scene(
        vertices=np.array(stored.vertices),
        faces=np.array(stored.faces),
        face_materials=np.array(stored.face_materials),
        materials=stored.materials,
        face_objects=np.zeros(count, np.int32),
        objects=("scene",),
        face_thickness=None if stored.face_thickness is None else np.array(stored.face_thickness),
    )
    sheets = opaque_walls(count, loss_db=0.0)
    found = walls_of(site, scene, sheets.solid, sheets.outward)
    if found.passable.any():
        # Only now does it matter which of them enclose solids.
        return scene_walls(site, prepare_scene(site, scene))
    return found


def walls_of_twin(twin: Twin) -> Walls:
    """Return the walls of a twin's scene."""
    return _walls(scene_walls(twin.site, twin))


def _walls(walls: SceneWalls) -> Walls:
    return Walls(
        permittivity=walls.permittivity,
        thickness=walls.thickness,
        reflection_loss_db=walls.reflection_loss_db,
        transmission_loss_db=walls.transmission_loss_db,
        solid=walls.solid,
        carrier_ghz=walls.carrier_ghz,
        excess_length=walls.excess_length,
    )
