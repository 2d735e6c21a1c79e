"""The bundled example: a small production hall full of machines, racks and shelves.

The hall measures 8 x 18 x 2.5 m and has one station in each top corner. Its clutter is inspired by the indoor
industrial scenario of 5G-ACIA: machines, racks and shelves, some up to just below the ceiling. Each station has
line of sight to 40 to 45 % of the free space.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import trimesh

HALL_SIZE = (8.0, 18.0, 2.5)
"""Length of the hall along x, y and z, m."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned solid of the clutter.

    Attributes
    ----------
    name : str
        Name of the object in the scene file.
    material : str
        Material name, as ITU-R P.2040 lists it.
    low, high : tuple of float
        Opposite corners, m.
    """

    name: str
    material: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]


def hall_boxes() -> list[Box]:
    """Solids of the hall's clutter: machines, cabinets, racks, a conveyor and two pillars."""
    boxes: list[Box] = []
    machines = [
        ((1.2, 1.2), (2.6, 2.6), 2.0),
        ((4.8, 1.4), (6.2, 2.5), 2.2),
        ((5.3, 4.6), (6.5, 6.1), 2.2),
        ((0.8, 5.7), (2.0, 7.1), 2.3),
        ((0.5, 10.7), (1.8, 11.9), 2.1),
        ((5.8, 12.3), (7.1, 13.6), 2.1),
        ((1.9, 15.9), (3.2, 17.1), 2.0),
        ((5.9, 15.9), (7.2, 17.1), 2.1),
    ]
    for i, ((x0, y0), (x1, y1), height) in enumerate(machines, start=1):
        boxes.append(Box(name=f"machine_{i}", material="metal", low=(x0, y0, 0.0), high=(x1, y1, height)))
        # Each machine has a control cabinet at its side.
        boxes.append(
            Box(
                name=f"cabinet_{i}",
                material="metal",
                low=(x1 + 0.01, y0 + 0.2, 0.0),
                high=(x1 + 0.41, y0 + 0.8, 1.6),
            )
        )
    boxes.extend(_rack("rack_1", (3.75, 4.1), (4.45, 7.1)))
    boxes.extend(_rack("rack_2", (3.0, 10.7), (3.7, 13.7)))
    boxes.extend(_rack("rack_3", (0.9, 8.9), (3.0, 9.5)))
    boxes.extend(_rack("rack_4", (5.3, 8.0), (7.4, 8.6)))
    boxes.append(Box(name="conveyor", material="metal", low=(3.9, 15.2, 0.0), high=(4.5, 17.0, 0.9)))
    boxes.append(Box(name="pillar_1", material="concrete", low=(3.7, 7.7, 0.0), high=(4.1, 8.1, 2.5)))
    boxes.append(Box(name="pillar_2", material="concrete", low=(3.8, 14.2, 0.0), high=(4.2, 14.6, 2.5)))
    return boxes


def hall_stations() -> list[tuple[str, tuple[float, float, float]]]:
    """List identifiers and positions [m] of the four stations, one in each top corner."""
    x, y, z = HALL_SIZE
    return [
        ("bs1", (0.1, 0.1, z - 0.1)),
        ("bs2", (x - 0.1, 0.1, z - 0.1)),
        ("bs3", (x - 0.1, y - 0.1, z - 0.1)),
        ("bs4", (0.1, y - 0.1, z - 0.1)),
    ]


def hall_scene() -> "trimesh.Scene":
    """Make the hall as a trimesh scene, one named geometry per solid, metres, z up."""
    import trimesh
    from trimesh.visual.material import PBRMaterial

    colours = {"concrete": (176, 176, 170, 255), "metal": (108, 130, 150, 255), "wood": (176, 138, 92, 255)}
    scene = trimesh.Scene()
    room = trimesh.creation.box(bounds=[(0.0, 0.0, 0.0), HALL_SIZE])
    room.invert()  # seen from inside
    for name, material, mesh in [
        ("room", "concrete", room),
        *((b.name, b.material, trimesh.creation.box(bounds=[b.low, b.high])) for b in hall_boxes()),
    ]:
        mesh.visual = trimesh.visual.TextureVisuals(
            material=PBRMaterial(name=f"itu_{material}", baseColorFactor=colours[material])
        )
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    return scene


def _rack(name: str, low: tuple[float, float], high: tuple[float, float]) -> list[Box]:
    """Build a rack: two end panels, four boards, and goods on the boards with gaps between them."""
    (x0, y0), (x1, y1) = low, high
    along_x = x1 - x0 > y1 - y0
    height, thickness = 2.25, 0.04
    start, end = (x0, x1) if along_x else (y0, y1)

    def span(a: float, b: float, z0: float, z1: float, part: str, material: str, inset: float = 0.0) -> Box:
        lo = (a, y0 + inset, z0) if along_x else (x0 + inset, a, z0)
        hi = (b, y1 - inset, z1) if along_x else (x1 - inset, b, z1)
        return Box(name=f"{name}_{part}", material=material, low=lo, high=hi)

    boxes = [
        span(start, start + thickness, 0.0, height, "end_1", "metal"),
        span(end - thickness, end, 0.0, height, "end_2", "metal"),
    ]
    levels = [0.05, 0.8, 1.5, height - thickness]
    inner_start, inner_end = start + thickness, end - thickness
    for i, z in enumerate(levels):
        boxes.append(span(inner_start, inner_end, z, z + thickness, f"board_{i + 1}", "metal"))
    # Three stacks of goods per board; every third position stays empty, so that rays pass through.
    width = (inner_end - inner_start) / 4
    for i, z in enumerate(levels[:-1]):
        for j in range(4):
            if (i + j) % 3 == 2:
                continue
            a = inner_start + j * width
            boxes.append(
                span(
                    a + 0.03,
                    a + width - 0.03,
                    z + thickness,
                    z + 0.64,
                    f"goods_{i + 1}{j + 1}",
                    "wood",
                    inset=0.04,
                )
            )
    return boxes
