"""Thin partitions between rooms are told; solid walls, screens, furniture and halls are not.

::

    y = 8 +---------+---------+      seen from above: two rooms of 5 x 8 x 2.7 m with a door of 0.9 m between them,
          |         |         |      above which the wall goes on
          |    a    |    b    |
          |                   |
          |         |         |
    y = 0 +---------+---------+
        x = 0       5        10
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from rayfix_offline.check import check_site
from rayfix_offline.site import read_site
from rayfix_offline.twin.findings import Finding
from rayfix_offline.twin.twin import prepare_twin
from tests.support.scenes.sites import stations_text

Box = tuple[tuple[float, float, float], tuple[float, float, float]]

HEIGHT = 2.7
GAP = 1e-3  # m, so that walls and room are parts of their own


def wall(thickness: float, height: float = HEIGHT - GAP) -> list[Box]:
    """Three boxes: the wall at either side of the door, and above it."""
    low, high = 5.0 - 0.5 * thickness, 5.0 + 0.5 * thickness
    boxes = [((low, GAP, GAP), (high, 3.0, height)), ((low, 3.9, GAP), (high, 8.0 - GAP, height))]
    return boxes + ([((low, 3.0, 2.1), (high, 3.9, height))] if height > 2.1 else [])


def partitions(
    folder: Path,
    boxes: Sequence[Box],
    *,
    material: str = "",
    carrier_ghz: float = 3.5,
    shift: Sequence[float] = (0, 0, 0),
) -> list[Finding]:
    """Return the findings about partitions of the two rooms with boxes in them."""
    room = trimesh.creation.box(bounds=[(0, 0, 0), (10, 8, HEIGHT)])
    room.invert()
    lines, count = [], 1
    meshes = [
        ("room", "", room),
        *((f"box{n}", material, trimesh.creation.box(bounds=box)) for n, box in enumerate(boxes)),
    ]
    for name, named, mesh in meshes:
        lines += [f"o {name}", f"usemtl {named or 'paint'}"]
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in np.add(mesh.vertices, shift).tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + count]
        count += len(mesh.vertices)
    (folder / "rooms.obj").write_text("\n".join(lines))
    stations = {"a": np.add((1.0, 1.0, 2.0), shift).tolist(), "b": np.add((9.0, 7.0, 2.0), shift).tolist()}
    path = folder / "site.toml"
    path.write_text(
        '[site]\nname = "rooms"\nscene = "rooms.obj"\n[propagation]\nmax_reflections = 0\n'
        f"carrier_ghz = {carrier_ghz}\n" + stations_text(stations)
    )
    twin = prepare_twin(read_site(path), folder)
    return [finding for finding in twin.findings if finding.kind == "thin partition"]


@pytest.mark.parametrize("thickness", [0.02, 0.1, 0.15])
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (448_250.0, 5_412_330.0, 512.0)])
def test_a_thin_wall_between_rooms(tmp_path: Path, thickness: float, shift: Sequence[float]) -> None:
    (finding,) = partitions(tmp_path, wall(thickness), shift=shift)
    assert finding.severity == "warning"
    assert "divide the free space into 2 rooms: box0, box1" in finding.problem
    assert "at 3.5 GHz" in finding.problem
    assert "leave thin partitions and doors out of the mesh" in finding.remedy
    assert "give their materials a thickness_m in [materials.NAME]" in finding.remedy


@pytest.mark.parametrize("material", ["itu_plasterboard", "itu_wood", "itu_glass"])
def test_a_thin_wall_of_light_material(tmp_path: Path, material: str) -> None:
    assert len(partitions(tmp_path, wall(0.1), material=material)) == 1


@pytest.mark.parametrize("material", ["itu_concrete", "itu_metal.001", "mat-itu_brick"])
def test_a_thin_wall_of_heavy_material_is_none(tmp_path: Path, material: str) -> None:
    assert not partitions(tmp_path, wall(0.1), material=material)


@pytest.mark.parametrize(
    "boxes",
    [
        wall(0.35),
        wall(0.1, height=1.6),
        [((5.0, 2.0, GAP), (5.1, 6.0, HEIGHT - GAP))],  # a screen that one walks around
        [((float(x), 2.0, GAP), (x + 0.15, 2.15, HEIGHT - GAP)) for x in range(1, 10)],  # columns
        [],
    ],
    ids=["thick", "low", "screen", "columns", "empty"],
)
def test_what_is_no_thin_partition(tmp_path: Path, boxes: list[Box]) -> None:
    assert not partitions(tmp_path, boxes)


def test_high_frequencies_do_not_pass(tmp_path: Path) -> None:
    assert not partitions(tmp_path, wall(0.1), carrier_ghz=28.0)


def test_the_hall_has_none(hall_site_path: Path) -> None:
    assert not check_site(hall_site_path).findings


def test_an_office_of_sheets(tmp_path: Path) -> None:
    """Walls without a thickness along a corridor."""

    def sheet(a: Sequence[float], b: Sequence[float]) -> NDArray[np.float64]:
        p, q = (*a, GAP), (*b, GAP)
        r, s = (*b, HEIGHT - GAP), (*a, HEIGHT - GAP)
        return np.array([[p, q, r], [p, r, s]])

    room = trimesh.creation.box(bounds=[(0, 0, 0), (12, 8, HEIGHT)])
    room.invert()
    sheets = [
        sheet((4.0 * n + a, y), (4.0 * n + b, y))
        for n in range(3)
        for y in (3.2, 4.8)
        for a, b in ((0.01, 1.5), (2.4, 3.99))
    ]
    sheets += [sheet((x, a), (x, b)) for x in (4.0, 8.0) for a, b in ((0.01, 3.19), (4.81, 7.99))]
    walls = np.concatenate(sheets)
    vertices = np.concatenate([room.vertices, walls.reshape(-1, 3)])
    faces = np.concatenate([room.faces, np.arange(3 * len(walls)).reshape(-1, 3) + len(room.vertices)])
    (tmp_path / "office.ply").write_bytes(trimesh.Trimesh(vertices, faces, process=False).export(file_type="ply"))
    (tmp_path / "site.toml").write_text(
        '[site]\nname = "office"\nscene = "office.ply"\n' + stations_text({"a": (6.0, 4.0, 2.5), "b": (2.0, 1.0, 2.5)})
    )
    found = prepare_twin(read_site(tmp_path / "site.toml"), tmp_path).findings
    (finding,) = [finding for finding in found if finding.kind == "thin partition"]
    assert "into 7 rooms" in finding.problem
