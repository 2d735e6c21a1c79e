"""Mitsuba XML scenes, as Sionna RT and Blender's Mitsuba exporter write them.

Supports the parts of the format that buildings need: shapes of type ``ply`` with ``to_world`` transforms, and the names
of their materials. Sionna RT 1 writes ``<bsdf type="itu-radio-material">`` with a ``type`` and a ``thickness`` in
metres; earlier versions and Blender write any bsdf with an id like ``mat-itu_concrete``. Cameras, lights and
integrators are ignored.
"""

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.formats.collada_transforms import rotation
from rayfix_offline.scene.formats.ply import read_ply
from rayfix_offline.scene.formats.xml_limits import refuse_hostile_xml
from rayfix_offline.scene.materials import itu_name
from rayfix_offline.scene.placed import MOST_TRIANGLES, Contents, Placed, Remark, one_material
from rayfix_offline.scene.scene_folder import inside, is_file, outside_error
from rayfix_tables.errors import SceneError

_LARGEST = 1e9
_LONGEST_DEFAULT = 1000
_UNREADABLE = "export the scene again, with a Mitsuba exporter"


def read_mitsuba(path: Path) -> Contents:
    """Read the shapes of a Mitsuba scene.

    Returns
    -------
    Contents
        An object has the material name of its shape, and the thickness of its material; the different spellings of
        ITU-R materials become ``itu_concrete`` and so on.

    Raises
    ------
    SceneError
        When the file or one of its meshes cannot be read, or has unsupported elements.
    """
    root = _parse(path)
    defaults = {element.get("name", ""): element.get("value", "") for element in root.iter("default")}
    for key, value in defaults.items():
        if len(value) > _LONGEST_DEFAULT:
            raise SceneError(
                f"{path} has a default '{key[:50]}' of {len(value):,} characters, more than {_LONGEST_DEFAULT}; "
                "write the value where it is used"
            )
    for element in root.iter():
        for key, value in element.attrib.items():
            if "$" in value:
                element.set(key, _substitute(value, defaults))
    if root.find("include") is not None:
        raise SceneError(f"{path} includes another file, which is not supported; export the scene as one file")
    materials = {element.get("id", ""): _material(element, path) for element in root.iter("bsdf")}
    placed: list[Placed] = []
    remarks: list[Remark] = []
    num_triangles = 0
    for number, shape in enumerate(root.iter("shape"), 1):
        name = (shape.get("id") or shape.get("name") or f"shape {number}").removeprefix("mesh-")
        where = f"{path}, shape '{name}'"
        kind = shape.get("type", "")
        if kind != "ply":
            raise SceneError(f"{where} is of type '{kind}', which is not supported; export it as ply")
        transform = _to_world(shape, where)
        material, thickness = _shape_material(shape, materials, where, path)
        mesh, remarked = _mesh(path, shape, where)
        materials_of, face_materials = one_material(material, len(mesh.faces))
        placed.append(
            replace(
                mesh,
                name=name,
                materials=materials_of,
                face_materials=face_materials,
                transform=transform,
                thickness=thickness,
            )
        )
        remarks += [replace(each, problem=f"shape '{name}': {each.problem}") for each in remarked]
        num_triangles += len(mesh.faces)
        if num_triangles > MOST_TRIANGLES:
            raise SceneError(
                f"{where}: the scene has more than {MOST_TRIANGLES:,} triangles up to here; leave out what is small"
            )
    return Contents(objects=tuple(placed), remarks=tuple(remarks))


def _parse(path: Path) -> ElementTree.Element:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise SceneError(f"{path} cannot be read ({error.strerror}); correct 'scene' in the site file") from error
    except UnicodeDecodeError as error:
        raise SceneError(f"{path} cannot be read as XML: it is not UTF-8; {_UNREADABLE}") from error
    refuse_hostile_xml(path, text.encode(), "utf-8")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise SceneError(f"{path} cannot be read as XML ({error}); {_UNREADABLE}") from error
    if root.tag != "scene":
        raise SceneError(f"{path} is not a Mitsuba scene: its root is <{root.tag[:50]}>, not <scene>; {_UNREADABLE}")
    return root


def _substitute(value: str, defaults: dict[str, str]) -> str:
    # Replaced once, not recursively: defaults that refer to each other could grow without bound.
    return re.sub(r"\$(\w+)", lambda match: defaults.get(match[1], match[0]), value)


def _material(bsdf: ElementTree.Element, path: Path) -> tuple[str | None, float]:
    """Name of a bsdf's material, None if it has none, and its thickness in m, NaN if it has none."""
    for element in bsdf.iter("float"):
        if element.get("name") == "thickness":
            where = f"{path}, material '{bsdf.get('id', '')}'"
            return _material_name(bsdf), _thickness(element.get("value", ""), where)
    return _material_name(bsdf), np.nan


def _thickness(text: str, where: str) -> float:
    try:
        thickness = float(text)
    except ValueError:
        thickness = np.nan
    if not 0.0 < thickness < _LARGEST:
        raise SceneError(f"{where} has the thickness '{text[:60]}'; give metres, more than 0")
    return thickness


def _material_name(bsdf: ElementTree.Element) -> str | None:
    """Name of a bsdf's material, None if it has none."""
    for element in bsdf.iter("bsdf"):
        if element.get("type") == "itu-radio-material":
            kind = element.find("string[@name='type']")
            if kind is not None and kind.get("value"):
                return f"itu_{kind.get('value')}"
    names = [element.get("id") or element.get("name") for element in bsdf.iter("bsdf")]
    for name in names:
        known = itu_name(name) if name else None
        if known:
            return f"itu_{known}"
    return next((name.removeprefix("mat-") for name in names if name), None)


def _shape_material(
    shape: ElementTree.Element, materials: dict[str, tuple[str | None, float]], where: str, path: Path
) -> tuple[str | None, float]:
    own = shape.find("bsdf")
    if own is not None:
        return _material(own, path)
    for reference in shape.findall("ref"):
        if reference.get("name", "bsdf") != "bsdf":
            continue
        target = reference.get("id", "")
        if target not in materials:
            raise SceneError(
                f"{where} refers to the material '{target}', which the file does not define; add its <bsdf>"
            )
        return materials[target]
    return None, np.nan


def _mesh(path: Path, shape: ElementTree.Element, where: str) -> tuple[Placed, tuple[Remark, ...]]:
    """Triangles of a shape's file, and remarks about it."""
    element = shape.find("string[@name='filename']")
    if element is None or not element.get("value"):
        raise SceneError(f'{where} names no file; add <string name="filename" value="....ply"/>')
    name = str(element.get("value"))
    file = inside(path.parent, path.parent, name)
    if file is None:
        raise outside_error(where, name)
    if not is_file(file):
        raise SceneError(f"{where} needs {name}, which is missing; put it next to the scene file")
    contents = read_ply(file)
    mesh = contents.objects[0]
    if not len(mesh.faces):
        raise SceneError(f"{where}: {name} holds no triangles; export it as a triangle mesh")
    return mesh, contents.remarks


def _to_world(shape: ElementTree.Element, where: str) -> NDArray[np.float64]:
    """Transform of a shape, shape (4, 4): the product of its operations."""
    transform = np.eye(4)
    for element in shape.findall("transform"):
        if element.get("name") not in ("to_world", "toWorld"):
            continue
        for operation in element:
            transform = _operation(operation, where) @ transform
            if not np.abs(transform).max() < _LARGEST:
                raise SceneError(f"{where} has a transform with numbers beyond {_LARGEST:g}; export the scene again")
    if not np.array_equal(transform[3], (0.0, 0.0, 0.0, 1.0)):
        raise SceneError(f"{where} has a perspective transform; give its matrix the last row 0 0 0 1")
    return transform


def _operation(element: ElementTree.Element, where: str) -> NDArray[np.float64]:
    """Matrix of one element of a transform, shape (4, 4)."""
    out = np.eye(4)
    if element.tag == "translate":
        out[:3, 3] = _vector(element, where, missing=0.0)
    elif element.tag == "scale":
        out[:3, :3] = np.diag(_vector(element, where, missing=1.0))
    elif element.tag == "rotate":
        axis = _vector(element, where, missing=0.0)
        length = np.linalg.norm(axis)
        if not length > 0.0:
            raise SceneError(f"{where} has a rotation without an axis; give x, y or z a value in <rotate>")
        angle = np.deg2rad(_numbers(element.get("angle", ""), where, (1,))[0])
        out = rotation(axis, float(angle))
    elif element.tag == "matrix":
        values = _numbers(element.get("value", ""), where, (9, 16))
        size = 3 if len(values) == 9 else 4
        out[:size, :size] = values.reshape(size, size)
    else:
        raise SceneError(
            f"{where} has the transform <{element.tag}>, which is not supported; use matrix, translate, scale or rotate"
        )
    return out


def _vector(element: ElementTree.Element, where: str, *, missing: float) -> NDArray[np.float64]:
    """Vector of an element, from its ``value`` or its ``x``, ``y`` and ``z``."""
    value = element.get("value")
    if value is not None:
        return np.broadcast_to(_numbers(value, where, (1, 3)), 3)
    return np.concatenate([_numbers(element.get(axis, str(missing)), where, (1,)) for axis in "xyz"])


def _numbers(text: str, where: str, counts: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        numbers = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) not in counts or not np.all(np.abs(numbers) < _LARGEST):
        expected = " or ".join(str(count) for count in counts)
        raise SceneError(
            f"{where} has a transform with the value '{text[:60]}'; give {expected} finite numbers below {_LARGEST:g}"
        )
    return numbers
