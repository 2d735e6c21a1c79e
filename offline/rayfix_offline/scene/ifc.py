"""IFC building models, through ifcopenshell (LGPL-3.0-or-later, used as a library; extra ``rayfix[ifc]``).

Every product with a body is one object, in metres and world coordinates, z up as IFC has it. Openings are cut out of
the walls that they void, and are no objects themselves; neither are spaces. Doors and windows are objects: they count
as closed.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

from rayfix_offline.scene.materials import itu_name
from rayfix_offline.scene.placed import Placed
from rayfix_tables.errors import SceneError

if TYPE_CHECKING:
    import ifcopenshell

NO_BODIES = ("IfcOpeningElement", "IfcSpace", "IfcVirtualElement", "IfcAnnotation", "IfcGrid")
"""Classes whose geometry is not there to be touched."""

CATEGORIES = {
    "aluminium": "metal",
    "steel": "metal",
    "block": "brick",
    "gypsum": "plasterboard",
}
"""Material of ITU-R P.2040 for what IFC 4 suggests as ``Category`` of a material and P.2040 calls otherwise."""


def read_ifc(path: Path) -> list[Placed]:
    """Read the bodies of an IFC file's products.

    Returns
    -------
    list of (name, mesh, transform)
        The name is the product's, with its GlobalId. A mesh has one material, so that a product of several materials
        is several meshes; it is called ``itu_concrete`` and so on where style, material or the material's category
        tell one of ITU-R P.2040.

    Raises
    ------
    SceneError
        When ifcopenshell is not installed, or the file cannot be read.
    """
    try:
        import ifcopenshell.geom
    except ModuleNotFoundError as error:
        raise SceneError(
            f"{path} is an IFC file, for which the module '{error.name}' is not installed; install it with: "
            "pip install 'rayfix[ifc]'"
        ) from error
    if not path.read_bytes().rstrip().endswith(b"END-ISO-10303-21;"):
        # ifcopenshell takes what there is of a truncated file.
        raise SceneError(f"{path} cannot be read as IFC (it does not end as such a file does); export the model again")
    try:
        file = ifcopenshell.open(str(path))
        placed = list(_products(file))
    except Exception as error:  # ifcopenshell raises whatever a damaged file brings up
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SceneError(f"{path} cannot be read as IFC ({reason}); export the model again") from error
    return placed


def _products(file: "ifcopenshell.file") -> Iterator[Placed]:
    import ifcopenshell.geom
    from ifcopenshell.util.element import get_materials

    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    settings.set("apply-default-materials", False)
    iterator = ifcopenshell.geom.iterator(settings, file, exclude=list(NO_BODIES))
    for shape in iterator:
        product = file.by_guid(shape.guid)
        materials = get_materials(product)
        geometry = shape.geometry
        vertices = np.asarray(geometry.verts, np.float64).reshape(-1, 3)
        faces = np.asarray(geometry.faces, np.int64).reshape(-1, 3)
        styles = np.asarray(geometry.material_ids, np.int64)
        for style in np.unique(styles):
            mesh = trimesh.Trimesh(vertices, faces[styles == style], process=False)
            named = file.by_id(geometry.materials[style].instance_id()) if style >= 0 else None
            material = _material(getattr(named, "Name", None), materials)
            if material:
                mesh.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name=material))
            yield f"{product.Name or product.is_a()} ({product.GlobalId})", mesh, np.eye(4)


def _material(style: str | None, materials: list[Any]) -> str | None:
    """Name of a surface's material, from its style and the product's materials.

    What ITU-R P.2040 knows comes first, from the most particular to the most general: the surface's style, the names of
    the product's materials (a wall's layers in their order), their categories.
    """
    own = [material for material in materials if material.Name == style] or materials
    categories = [(getattr(material, "Category", None) or "").lower() for material in own]
    names = [style, *(material.Name for material in own), *(CATEGORIES.get(name, name) for name in categories)]
    for name in names:
        known = itu_name(name) if name else None
        if known:
            return f"itu_{known}"
    return next((name for name in (*(material.Name for material in own), style) if name), None)
