"""Limits on the nodes of glTF files, checked before a reader traverses them."""

import codecs
import json
from pathlib import Path

from rayfix_offline.scene.formats.xml_limits import MOST_NESTED
from rayfix_tables.errors import SceneError

_JSON_CHUNK = b"JSON"


def refuse_hostile_gltf(path: Path, content: bytes) -> None:
    """Refuse nodes that form a cycle, have two parents, or are nested too deeply.

    A file that is not glTF is left to the reader's error.

    Raises
    ------
    SceneError
        When the nodes are not trees, or more than 200 deep.
    """
    try:
        nodes = json.loads(json_of(content))["nodes"]
        children = [[int(child) for child in node.get("children", ())] for node in nodes]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return
    parents: dict[int, int] = {}
    for number, each in enumerate(children):
        for child in each:
            if not 0 <= child < len(children):
                return
            if child in parents:
                raise SceneError(f"{path} has the node {child} in two other nodes; export the scene again, as trees")
            parents[child] = number
    # From the roots downwards; a cycle has no root.
    level, found = [number for number in range(len(children)) if number not in parents], 0
    for depth in range(MOST_NESTED + 1):
        if not level:
            break
        if depth == MOST_NESTED:
            raise SceneError(
                f"{path} has nodes nested more than {MOST_NESTED} deep; export the scene again, with a flatter "
                "structure"
            )
        found += len(level)
        level = [child for number in level for child in children[number]]
    if found < len(children):
        raise SceneError(f"{path} has nodes that form a cycle; export the scene again, as trees")


def json_of(content: bytes) -> bytes:
    """Return the JSON of a file; in a binary file it is the first chunk.

    Raises
    ------
    ValueError
        When the first chunk is something else.
    """
    if content[:4] != b"glTF":
        return content.removeprefix(codecs.BOM_UTF8)
    if content[16:20] != _JSON_CHUNK:
        raise ValueError("the first chunk is not JSON")
    return content[20 : 20 + int.from_bytes(content[12:16], "little")]
