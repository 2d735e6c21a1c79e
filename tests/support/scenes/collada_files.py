"""COLLADA files written by hand."""

from collections.abc import Sequence

from tests.support.scenes.polygon_scene import Polygon, indexed

HEAD = (
    '<?xml version="1.0" encoding="utf-8"?>\n'
    '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
    '<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>'
)


def source_of(name: str, polygons: Sequence[Polygon]) -> tuple[str, list[list[int]]]:
    """Write source and vertices of a geometry; returns the corners of its polygons as well."""
    points, rings = indexed(polygons)
    numbers = " ".join(repr(v) for v in points.reshape(-1).tolist())
    params = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    return (
        f'<source id="{name}-p"><float_array id="{name}-pa" count="{points.size}">{numbers}</float_array>'
        f'<technique_common><accessor source="#{name}-pa" count="{len(points)}" stride="3">{params}</accessor>'
        f'</technique_common></source><vertices id="{name}-v"><input semantic="POSITION" source="#{name}-p"/>'
        "</vertices>"
    ), rings


def input_of(name: str) -> str:
    """Write the input of a surface."""
    return f'<input semantic="VERTEX" source="#{name}-v" offset="0"/>'


def polylist(name: str, rings: Sequence[Sequence[int]], *, material: str = "") -> str:
    """Write polygons as <polylist>."""
    sizes = " ".join(str(len(ring)) for ring in rings)
    corners = " ".join(str(k) for ring in rings for k in ring)
    said = f' material="{material}"' if material else ""
    return f'<polylist count="{len(rings)}"{said}>{input_of(name)}<vcount>{sizes}</vcount><p>{corners}</p></polylist>'


def polygons_of(name: str, rings: Sequence[Sequence[int]], *, material: str = "") -> str:
    """Write polygons as <polygons>."""
    said = f' material="{material}"' if material else ""
    each = "".join(f"<p>{' '.join(map(str, ring))}</p>" for ring in rings)
    return f'<polygons count="{len(rings)}"{said}>{input_of(name)}{each}</polygons>'


def triangles_of(name: str, rings: Sequence[Sequence[int]], *, material: str = "") -> str:
    """Write convex polygons as <triangles>."""
    faces = [(ring[0], ring[k], ring[k + 1]) for ring in rings for k in range(1, len(ring) - 1)]
    said = f' material="{material}"' if material else ""
    corners = " ".join(str(k) for face in faces for k in face)
    return f'<triangles count="{len(faces)}"{said}>{input_of(name)}<p>{corners}</p></triangles>'


def geometry(name: str, content: str) -> str:
    """Write a geometry from its source and its surfaces."""
    return f'<geometry id="{name}" name="{name}"><mesh>{content}</mesh></geometry>'


def document(geometries: str, nodes: str, *, materials: str = "", more: str = "") -> str:
    """Write a whole file."""
    return (
        f"{HEAD}<library_materials>{materials}</library_materials><library_geometries>{geometries}</library_geometries>"
        f'{more}<library_visual_scenes><visual_scene id="scene">{nodes}</visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#scene"/></scene></COLLADA>'
    )
