"""Limits of XML files, checked by a streaming parser before the tree is built."""

from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from rayfix_tables.errors import SceneError

MOST_NESTED = 200
"""Largest depth of nested elements; exporters write about ten, and readers recurse."""

MOST_INSTANCED = 200_000_000
"""Limit of the characters of triangle indices of all instances of a COLLADA file, unless the file itself is longer."""


def refuse_hostile_xml(path: Path, content: bytes, encoding: str | None = None) -> None:
    """Refuse content that expands a short file, reads other files or exhausts a reader's stack.

    Parameters
    ----------
    encoding : str, optional
        Encoding that overrides the file's declaration.

    Raises
    ------
    SceneError
        When the file is not XML, declares a document type or entities, or nests its elements too deeply.
    """
    parser = expat.ParserCreate(encoding)
    depth = 0

    def declared(*_: object) -> None:
        # Entities can expand without bound and read other files; no exporter writes them.
        raise SceneError(f"{path} declares a document type or entities, which is not allowed; remove <!DOCTYPE ...>")

    def begun(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > MOST_NESTED:
            raise SceneError(
                f"{path} has elements nested more than {MOST_NESTED} deep, in line {parser.CurrentLineNumber}; "
                "export the scene again, with a flatter structure"
            )

    def ended(*_: object) -> None:
        nonlocal depth
        depth -= 1

    parser.StartDoctypeDeclHandler = declared
    parser.EntityDeclHandler = declared
    parser.StartElementHandler = begun
    parser.EndElementHandler = ended
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError) as error:
        raise SceneError(f"{path} cannot be read as XML ({error}); export the scene again") from error


def refuse_hostile_collada(path: Path, content: bytes) -> None:
    """Refuse numbers that the COLLADA reader would change, and instances that expand a short file to a huge scene.

    The content has passed :func:`refuse_hostile_xml`.

    Raises
    ------
    SceneError
        When the file has numbers that are not finite in single precision, when its nodes instantiate each other in a
        cycle, or when its instances exceed the limit.
    """
    root = ElementTree.fromstring(content)
    _refuse_infinite(path, root)
    _refuse_multiplied(path, root, max(len(content), MOST_INSTANCED))


def _refuse_infinite(path: Path, root: ElementTree.Element) -> None:
    # The reader converts NaN to 0, and leaves out triangles with corners that are infinite in single precision. Only
    # positions are checked: exporters write normals of NaN.
    inputs = [element for element in root.iter() if kind_of(element) == "input"]
    positions = {each.get("source", "")[1:] for each in inputs if each.get("semantic") == "POSITION"}
    sources = [element for element in root.iter() if kind_of(element) == "source" and element.get("id") in positions]
    for element in (child for source in sources for child in source if kind_of(child) == "float_array"):
        words = (element.text or "").split()
        try:
            numbers = np.array(words, np.float64)
        except ValueError:
            continue  # the reader reports this
        wrong = np.flatnonzero(~(np.abs(numbers) <= np.finfo(np.float32).max))
        if len(wrong):
            raise SceneError(
                f"{path} has the number {words[wrong[0]][:50]} in the float_array '{element.get('id', '')[:50]}', "
                "which is not finite in single precision; export the scene again"
            )


def _refuse_multiplied(path: Path, root: ElementTree.Element, limit: int) -> None:
    nodes, sizes = {}, {}
    for element in root.iter():
        kind, name = kind_of(element), element.get("id")
        if kind == "node" and name:
            nodes[name] = element
        elif kind == "geometry" and name:
            sizes[name] = sum(len(each.text or "") for each in element.iter() if kind_of(each) == "p")
    known: dict[str, tuple[int, int]] = {}

    def measure(element: ElementTree.Element, depth: int) -> tuple[int, int]:
        """Return the number of characters that an element expands to, and the depth of its instances."""
        name = element.get("id", "") if kind_of(element) == "node" else ""
        if name in known:
            return known[name]
        if depth > MOST_NESTED:
            raise SceneError(
                f"{path} has nodes that instantiate each other more than {MOST_NESTED} deep, or in a circle; "
                "export the scene again, with a flatter structure"
            )
        size, height = 0, 0
        for child in element:
            kind, target = kind_of(child), child.get("url", "").removeprefix("#")
            if kind == "node":
                inner = measure(child, depth + 1)
            elif kind == "instance_node" and target in nodes:
                inner = measure(nodes[target], depth + 1)
            elif kind == "instance_geometry":
                inner = (sizes.get(target, 0), 0)
            else:
                continue
            size, height = size + inner[0], max(height, inner[1] + 1)
            if depth + height > MOST_NESTED:
                raise SceneError(
                    f"{path} has nodes that instantiate each other more than {MOST_NESTED} deep; "
                    "export the scene again, with a flatter structure"
                )
        if size > limit:
            raise SceneError(
                f"{path} instantiates its geometries so often that they expand to {size:,} characters of indices, more "
                f"than {limit:,}; export the scene in parts"
            )
        if name:
            known[name] = size, height
        return size, height

    for element in root.iter():
        if kind_of(element) == "visual_scene":
            measure(element, 0)


def kind_of(element: ElementTree.Element) -> str:
    """Return the tag of an element without its namespace."""
    return element.tag.rpartition("}")[2]
