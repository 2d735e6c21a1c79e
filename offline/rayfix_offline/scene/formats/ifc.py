"""IFC building models, through ifcopenshell (LGPL-3.0-or-later, used as a library; extra ``rayfix[ifc]``).

Every product with a body is one object, in metres and world coordinates, z up as IFC has it. Openings are cut out of
the walls that they void, and are no objects themselves; neither are spaces. Doors and windows are objects: they count
as closed.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rayfix_offline.scene.materials import itu_name
from rayfix_offline.scene.placed import Contents, Placed, Remark, counted, one_material
from rayfix_tables.errors import SceneError

if TYPE_CHECKING:
    import ifcopenshell

NO_BODIES = ("IfcOpeningElement", "IfcSpace", "IfcVirtualElement", "IfcAnnotation", "IfcGrid")
"""Classes with geometry that is not physical."""

CATEGORIES = {
    "aluminium": "metal",
    "steel": "metal",
    "block": "brick",
    "gypsum": "plasterboard",
}
"""Materials of ITU-R P.2040 for values that IFC 4 suggests for a material's ``Category``, where the names differ."""

BODIES = ("body", "body-fallback", "facetation", "tessellation", "surface", "")
"""Identifiers, in lower case, of representations by surfaces, as opposed to axes, plans and boxes."""

NEWEST = "IFC4X3_ADD2"
"""Schema of files that state IFC4X3: an addendum that corrects only texts."""

MOST_NAMED = 6

_END = re.compile(rb"\bEND-ISO-10303-21\s*;")
_REMARKS = re.compile(rb"/\*.*?\*/", re.DOTALL)


def read_ifc(path: Path) -> Contents:
    """Read the bodies of an IFC file's products.

    Returns
    -------
    Contents
        An object's name is its product's, with its GlobalId. An object has one material; a product of several materials
        becomes several objects, each with the thickness of its layers. The material is named ``itu_concrete`` and so on
        if style, material or the material's category identify one of ITU-R P.2040.

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
    remarks: list[Remark] = []
    content = _content(path, remarks)
    try:
        ifcopenshell.get_log()  # discards messages about other files
        file = ifcopenshell.file.from_string(content)
        placed = list(_products(file))
        remarks += _missing(file, placed)
        remarks += _errors(str(ifcopenshell.get_log()))
    except Exception as error:  # ifcopenshell raises various exceptions for damaged files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SceneError(f"{path} cannot be read as IFC ({reason}); export the model again") from error
    return Contents(objects=tuple(each for _, each in placed), remarks=tuple(remarks), metres=1.0, up="z")


def _content(path: Path, remarks: list[Remark]) -> str:
    """Text of the file from its first word to its end mark; the schema IFC4X3 is replaced by its addendum's name.

    ifcopenshell accepts truncated files, and reads beyond the end mark.
    """
    content = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    end = None
    for end in _END.finditer(content):  # noqa: B007  the last one
        pass
    if end is None:
        raise SceneError(f"{path} cannot be read as IFC (it does not end as such a file does); export the model again")
    if _REMARKS.sub(b"", content[end.end() :]).strip(b" \t\r\n\0\x1a"):
        problem = f"the file has {len(content) - end.end():,} bytes after its end mark, which are not read"
        remarks.append(Remark(kind="left out", problem=problem, remedy="export the model again"))
    text = content[: end.end()].decode("latin-1")
    return re.sub(r"(FILE_SCHEMA\s*\(\s*\(\s*')IFC4X3(')", rf"\g<1>{NEWEST}\g<2>", text, count=1, flags=re.IGNORECASE)


def _products(file: "ifcopenshell.file") -> Iterator[tuple[str, Placed]]:
    """Yield GlobalIds and objects."""
    import ifcopenshell.geom
    from ifcopenshell.util.element import get_materials
    from ifcopenshell.util.unit import calculate_unit_scale

    metres = float(calculate_unit_scale(file))
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
            own = faces[styles == style]
            named = file.by_id(geometry.materials[style].instance_id()) if style >= 0 else None
            style_name = getattr(named, "Name", None)
            material, face_materials = one_material(_material(style_name, materials), len(own))
            used, corners = np.unique(own, return_inverse=True)
            yield (
                shape.guid,
                Placed(
                    name=_name(product),
                    vertices=vertices[used],
                    faces=corners.reshape(-1, 3),
                    materials=material,
                    face_materials=face_materials,
                    thickness=_thickness(style_name, product) * metres,
                ),
            )


def _thickness(style: str | None, product: Any) -> float:
    """Thickness of the layers of a surface's style, or else of all layers, in the file's unit; NaN without layers."""
    from ifcopenshell.util.element import get_material

    layer_set = get_material(product, should_skip_usage=True)
    if layer_set is None or not layer_set.is_a("IfcMaterialLayerSet"):
        return np.nan
    layers = layer_set.MaterialLayers
    own = [layer for layer in layers if getattr(layer.Material, "Name", None) == style] or layers
    return float(sum(layer.LayerThickness for layer in own)) or np.nan


def _name(product: Any) -> str:
    return f"{product.Name or product.is_a()} ({product.GlobalId})"


def _missing(file: "ifcopenshell.file", placed: list[tuple[str, Placed]]) -> Iterator[Remark]:
    """Warn of products that have a body but no triangles."""
    found = {guid for guid, each in placed if len(each.faces)}
    missing = [
        product
        for product in file.by_type("IfcProduct")
        if product.GlobalId not in found and not any(product.is_a(kind) for kind in NO_BODIES) and _has_body(product)
    ]
    if missing:
        names = ", ".join(_name(product) for product in missing[:MOST_NAMED])
        more = f" and {len(missing) - MOST_NAMED:,} more" if len(missing) > MOST_NAMED else ""
        yield Remark(
            kind="left out",
            problem=f"no body can be made of {counted(len(missing), 'product')}: {names}{more}",
            remedy="mend them in the model, or export it with tessellated bodies",
        )


def _has_body(product: Any) -> bool:
    shape = getattr(product, "Representation", None)
    return shape is not None and any(
        (each.RepresentationIdentifier or "").lower() in BODIES for each in shape.Representations or ()
    )


def _errors(log: str) -> Iterator[Remark]:
    """Warn of other problems that ifcopenshell reports, such as openings that it could not cut."""
    entries = re.split(r"^(?=\[\w+\] )", log, flags=re.MULTILINE)
    problems = []
    for entry in entries:
        if entry.startswith("[error]"):
            text = re.sub(r"^(\[[^\]]*\] ?)+", "", " ".join(entry.split()))
            problems.append(text[:160])
    if problems:
        named = "; ".join(list(dict.fromkeys(problems))[:2])
        number = counted(len(problems), "error")
        yield Remark(
            kind="left out",
            problem=f"ifcopenshell reports {number}, and bodies or openings may be missing: {named}",
            remedy="mend them in the model, or export it with tessellated bodies",
        )


def _material(style: str | None, materials: list[Any]) -> str | None:
    """Name of a surface's material, from its style and the product's materials.

    Names of ITU-R P.2040 take precedence, from the most specific to the most general: the surface's style, the names of
    the product's materials (a wall's layers in order), their categories.
    """
    own = [material for material in materials if material.Name == style] or materials
    categories = [(getattr(material, "Category", None) or "").lower() for material in own]
    names = [style, *(material.Name for material in own), *(CATEGORIES.get(name, name) for name in categories)]
    for name in names:
        known = itu_name(name) if name else None
        if known:
            return f"itu_{known}"
    return next((name for name in (*(material.Name for material in own), style) if name), None)
