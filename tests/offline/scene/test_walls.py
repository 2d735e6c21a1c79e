"""What site file and scene file say of walls, resolved for each triangle."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rayfix_offline.rays.trace import scene_walls
from rayfix_offline.scene.materials import complex_permittivity
from rayfix_offline.scene.scene import Scene
from rayfix_offline.scene.slabs import excess_length, slab_power
from rayfix_offline.scene.walls import Walls, walls_of
from rayfix_offline.site import SiteFile, parse_site
from rayfix_offline.twin.findings import wall_findings
from rayfix_offline.twin.twin import Twin, prepare_scene
from rayfix_tables.errors import SiteError
from tests.support.scenes.rooms import scene_of
from tests.support.scenes.shapes import box

ROOM = ((0.0, 0.0, 0.0), (4.0, 5.0, 3.0))
SCREEN = np.array(
    [[(2.0, 0.5, 0.0), (2.0, 4.5, 0.0), (2.0, 4.5, 2.0)], [(2.0, 0.5, 0.0), (2.0, 4.5, 2.0), (2.0, 0.5, 2.0)]]
)


def site_of(materials: dict[str, Any] | None = None, **propagation: Any) -> SiteFile:
    """Site with materials, whose names of ITU-R P.2040 count."""
    return parse_site(
        {
            "site": {"name": "room", "scene": "room.glb"},
            "propagation": {"reflection": "itu", **propagation},
            "materials": materials or {},
            "stations": [{"id": "s", "position_m": [1, 2, 1]}],
        }
    )


def one_sheet(material: str, thickness: float | None = None) -> Scene:
    """Screen of one material."""
    return replace(
        scene_of(screen=SCREEN),
        face_materials=np.zeros(2, np.int16),
        materials=(material,),
        face_thickness=None if thickness is None else np.full(2, thickness),
    )


def sheet(site: SiteFile, material: str, thickness: float | None = None) -> Walls:
    """Walls of the screen."""
    return walls_of(site, one_sheet(material, thickness), np.full(2, -1, np.int32), np.zeros((2, 3)))


def seen(walls: Walls) -> list[float]:
    """Real permittivity, thickness and both losses of the first triangle."""
    return [
        float(walls.permittivity[0].real),
        float(walls.thickness[0]),
        float(walls.reflection_loss_db[0]),
        float(walls.transmission_loss_db[0]),
    ]


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("name", "section", "propagation", "expected"),
    [
        ("itu_glass", None, {}, [6.31, NAN, NAN, INF]),  # of unknown thickness
        ("itu_glass", {"thickness_m": 0.01}, {}, [6.31, 0.01, NAN, NAN]),
        ("itu_glass", {"thickness_m": 0.01}, {"reflection": "constant"}, [6.31, 0.01, NAN, NAN]),
        ("itu_glass", {"thickness_m": 0.01}, {"transmission": False}, [6.31, NAN, NAN, INF]),
        ("itu_metal", {"thickness_m": 0.001}, {}, [1.0, NAN, NAN, INF]),
        ("pane", {"itu": "glass", "thickness_m": 0.01}, {}, [6.31, 0.01, NAN, NAN]),
        ("pane", {"permittivity": 4.0, "thickness_m": 0.01}, {}, [4.0, 0.01, NAN, NAN]),
        ("pane", {"transmission_loss_db": 3.0}, {}, [NAN, NAN, 6.0, 3.0]),
        ("pane", {"transmission_loss_db": 3.0, "reflection_loss_db": 9.0}, {}, [NAN, NAN, 9.0, 3.0]),
        ("pane", {"transmission_loss_db": 3.0}, {"transmission": False}, [NAN, NAN, 6.0, INF]),
        ("itu_glass", {"transmission_loss_db": 3.0}, {}, [6.31, NAN, NAN, 3.0]),
        ("itu_glass", {"transmission_loss_db": 3.0}, {"reflection": "constant"}, [NAN, NAN, 6.0, 3.0]),
        ("itu_glass", {"reflection_loss_db": 3.0}, {}, [6.31, NAN, 3.0, INF]),
        ("itu_metal", {"transmission_loss_db": 30.0}, {}, [1.0, NAN, NAN, 30.0]),
        ("pane", None, {}, [NAN, NAN, 6.0, INF]),
    ],
)
def test_one_material(
    name: str, section: dict[str, Any] | None, propagation: dict[str, Any], expected: list[float]
) -> None:
    walls = sheet(site_of({} if section is None else {name: section}, **propagation), name)
    np.testing.assert_array_equal(seen(walls), expected)


def test_names_are_found_as_exporters_write_them() -> None:
    site = site_of({"glass": {"thickness_m": 0.01}, "Glass.002": {"thickness_m": 0.02}})
    found = {name: sheet(site, name).thickness[0] for name in ("mat-itu_glass", "glass", "Glass.002", "itu_wood")}
    np.testing.assert_array_equal(list(found.values()), [0.01, 0.01, 0.02, np.nan])


def test_the_file_states_a_thickness_and_the_site_another() -> None:
    assert sheet(site_of(), "itu_glass", 0.03).thickness[0] == 0.03
    assert sheet(site_of({"itu_glass": {"thickness_m": 0.01}}), "itu_glass", 0.03).thickness[0] == 0.01
    assert np.isnan(sheet(site_of(), "itu_metal", 0.03).thickness[0])
    assert not sheet(site_of(transmission=False), "itu_glass", 0.03).passable.any()


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"itu": "wood", "permittivity": 2.0}, "give one of them"),
        ({"conductivity_s_m": 2.0}, "conductivity_s_m needs permittivity"),
        ({"thickness_m": 0.0, "itu": "wood"}, "materials.pane.thickness_m"),
        ({"loss": 3.0}, "knows itu, permittivity"),
    ],
)
def test_what_a_site_may_not_say(section: dict[str, Any], message: str) -> None:
    with pytest.raises(SiteError, match=message):
        site_of({"pane": section})


def test_the_coefficients_of_triangles() -> None:
    walls = sheet(site_of({"itu_glass": {"thickness_m": 0.01}}), "itu_glass")
    faces, cosine = np.array([0], np.int32), np.array([0.6])
    glass = complex_permittivity("glass", 3.5)
    reflected, transmitted = slab_power(0.6, glass, 0.01, carrier_ghz=3.5)
    assert walls.reflected(faces, cosine)[0] == pytest.approx(np.log10(reflected))
    log_gain, excess = walls.transmitted(faces, cosine, walls.thickness[faces])
    assert log_gain[0] == pytest.approx(np.log10(transmitted))
    assert excess[0] == excess_length(0.6, glass, 0.01) > 0.0
    # A solid brings its own thickness.
    thicker = walls.transmitted(faces, cosine, np.array([0.3]))
    assert thicker[0][0] == pytest.approx(np.log10(slab_power(0.6, glass, 0.3, carrier_ghz=3.5)[1]))
    assert thicker[1][0] == pytest.approx(30 * excess[0])
    unmoved = replace(walls, excess_length=False).transmitted(faces, cosine, walls.thickness[faces])
    np.testing.assert_array_equal(unmoved, [[log_gain[0]], [0.0]])


def remarked(scene: Scene, site: SiteFile) -> list[str]:
    """Messages about materials of a scene."""
    return [finding.message for finding in wall_findings(site, scene)]


def test_what_is_known_of_walls_and_not_used_is_told() -> None:
    assert remarked(one_sheet("itu_glass"), site_of({"glass": {"thickness_m": 0.01}})) == []
    (unused,) = remarked(one_sheet("itu_glass"), site_of({"glas": {"transmission_loss_db": 3.0}}))
    assert unused == (
        "the site file describes 'glas', which the scene does not have; give the sections the names of the scene's "
        "materials: 'itu_glass'"
    )
    (bare,) = remarked(one_sheet("pane"), site_of({"pane": {"thickness_m": 0.1}}))
    assert bare == "materials.pane has a thickness but no permittivity; add itu, permittivity or transmission_loss_db"
    (paper,) = remarked(one_sheet("pane"), site_of({"pane": {"itu": "paper", "thickness_m": 0.1}}))
    assert paper.startswith("materials.pane.itu = 'paper' is not in ITU-R P.2040; it has vacuum, concrete, brick")
    (beyond,) = remarked(one_sheet("itu_brick"), site_of({"itu_brick": {"thickness_m": 0.1}}, carrier_ghz=60.0))
    assert beyond.startswith("the permittivity of 'itu_brick' is not known at carrier_ghz = 60, and its walls let")
    stated = one_sheet("itu_glass", 0.01)
    (silent,) = remarked(stated, site_of(reflection="constant"))
    assert "states the thickness of 'itu_glass', but" in silent
    assert remarked(stated, site_of()) == remarked(stated, site_of(reflection="constant", transmission=False)) == []


def solid_room(inwards: bool, mixed: bool = False) -> Twin:
    """Room with a screen and a solid crate."""
    crate = box((1.0, 3.0, 0.5), (1.5, 4.0, 1.5))
    if inwards:
        crate = crate[:, ::-1]
    if mixed:
        crate[3] = crate[3, ::-1]
    return prepare_scene(site_of(), scene_of(room=box(*ROOM)[:, ::-1], screen=SCREEN, crate=crate))


@pytest.mark.parametrize("inwards", [False, True])
@pytest.mark.parametrize("mixed", [False, True])
def test_solids_and_their_normals(inwards: bool, mixed: bool) -> None:
    twin = solid_room(inwards, mixed)
    crate = twin.scene.face_objects == 2
    np.testing.assert_array_equal(twin.solid >= 0, crate)
    assert len(np.unique(twin.solid[crate])) == 1
    from_middle = twin.scene.triangles[crate].mean(axis=1) - [1.25, 3.5, 1.0]
    assert np.all(np.einsum("ij,ij->i", from_middle, twin.outward[crate]) > 0.2)
    np.testing.assert_allclose(np.linalg.norm(twin.outward, axis=1), 1.0, rtol=1e-12)
    assert not scene_walls(twin.site, twin).passable.any()
