"""Permittivities and reflection coefficients against hand-made numbers, and what the launch makes of them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from trimesh.visual.material import PBRMaterial

from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_evaluation.truth.fresnel import half_space
from rayfix_evaluation.truth.walls import Walls as SolverWalls
from rayfix_offline.build import build_table
from rayfix_offline.rays.trace import scene_walls
from rayfix_offline.scene.materials import (
    ITU_MATERIALS,
    ReflectionSettings,
    complex_permittivity,
    face_permittivity,
    fresnel_coefficients,
    fresnel_power,
    itu_name,
)
from rayfix_offline.scene.walls import Walls, opaque_walls
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import prepare_twin, refuse_errors
from rayfix_tables.table import Table
from tests.support.oracles.rays import Rows

WriteSite = Callable[..., Path]
Launch = Callable[..., Rows]
cosines = st.floats(0.0, 1.0)
permittivities = st.builds(lambda re, im: complex(re, -im), st.floats(1.0, 100.0), st.floats(0.0, 1e8))


def known(name: str, carrier_ghz: float) -> complex:
    """Permittivity of a material that the table has."""
    found = complex_permittivity(name, carrier_ghz)
    assert found is not None
    return found


def half_spaces(permittivity: NDArray[np.complex128], loss_db: float) -> Walls:
    """Triangles of these permittivities that let nothing through; the loss is that of NaN."""
    walls = opaque_walls(len(permittivity), loss_db=loss_db)
    loss = np.where(np.isnan(permittivity), walls.reflection_loss_db, np.nan)
    return replace(walls, permittivity=permittivity, reflection_loss_db=loss)


@pytest.mark.parametrize(
    ("name", "carrier_ghz", "real", "conductivity"),
    [
        ("concrete", 3.5, 5.24, 0.12308),  # 0.0462 x 3.5^0.7822
        ("glass", 28.0, 6.31, 0.31234),  # 0.0036 x 28^1.3394
        ("glass", 300.0, 5.79, 5.1176),  # 0.0004 x 300^1.658
        ("plywood", 2.4, 2.71, 0.33),
        ("metal", 3.5, 1.0, 1e7),
        ("wet_ground", 2.0, 22.736, 0.36934),  # 30 x 2^-0.4, 0.15 x 2^1.3
    ],
)
def test_permittivities(name: str, carrier_ghz: float, real: float, conductivity: float) -> None:
    """The imaginary part is 17.98 sigma / f in ITU-R P.2040-3, whose factor is rounded to four digits."""
    found = known(name, carrier_ghz)
    assert found.real == pytest.approx(real, rel=1e-4)
    assert found.imag == pytest.approx(-17.98 * conductivity / carrier_ghz, rel=3e-4)


@pytest.mark.parametrize(
    "name",
    [
        "concrete",
        "itu_concrete",
        "itu-concrete",
        "ITU_Concrete",
        "mat-itu_concrete",
        "mat-itu_concrete.001",
        "itu concrete.12",
        " concrete ",
    ],
)
def test_names_of_one_material(name: str) -> None:
    assert itu_name(name) == "concrete"
    assert complex_permittivity(name, 3.5) == complex_permittivity("concrete", 3.5)


@pytest.mark.parametrize(
    "name", ["", "itu_", "mat-", "steel", "concrete wall", "itu_itu_concrete", ".001", "concrete.x"]
)
def test_names_of_no_material(name: str) -> None:
    assert itu_name(name) is None
    assert complex_permittivity(name, 3.5) is None


def test_names_of_two_words() -> None:
    assert itu_name("mat-itu_ceiling_board") == itu_name("ITU-Ceiling-Board.003") == "ceiling_board"
    assert itu_name("very dry ground") == "very_dry_ground"


@pytest.mark.parametrize(
    ("name", "carrier_ghz"), [("concrete", 0.9), ("concrete", 101.0), ("floorboard", 3.5), ("glass", 150.0)]
)
def test_frequencies_that_the_table_does_not_have(name: str, carrier_ghz: float) -> None:
    assert complex_permittivity(name, carrier_ghz) is None


def test_all_materials_are_passive_wherever_they_are_known() -> None:
    for name, rows in ITU_MATERIALS.items():
        for row in rows:
            for carrier in (row.lowest_ghz, row.highest_ghz):
                found = known(name, carrier)
                assert found.real >= 1.0
                assert found.imag <= 0.0


# Fresnel's coefficients


@given(permittivity=permittivities)
def test_normal_incidence(permittivity: complex) -> None:
    """Both polarisations are one there."""
    index = np.sqrt(permittivity)
    expected = abs((1.0 - index) / (1.0 + index)) ** 2
    assert fresnel_power(1.0, permittivity) == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_concrete_reflects_a_sixth() -> None:
    """At normal incidence and 3.5 GHz its index is 2.2932 - 0.1378j: (1.2932^2 + 0.1378^2) / (3.2932^2 + 0.1378^2)."""
    assert fresnel_power(1.0, known("concrete", 3.5)) == pytest.approx(0.15569, abs=2e-5)


@pytest.mark.parametrize("permittivity", [1.5, 4.0, 6.31, 80.0])
def test_brewster_angle(permittivity: float) -> None:
    """At tan = sqrt(eps), a lossless dielectric reflects no TM wave, and ((1 - eps) / (1 + eps))^2 of a TE wave."""
    te, tm = fresnel_coefficients(np.cos(np.arctan(np.sqrt(permittivity))), permittivity)
    assert abs(tm) < 1e-14
    assert te.real == pytest.approx((1.0 - permittivity) / (1.0 + permittivity), rel=1e-13)


def test_metal_reflects_everything() -> None:
    cosine = np.cos(np.deg2rad(np.arange(0.0, 85.0)))
    power = fresnel_power(cosine, known("metal", 3.5))
    assert np.all(power > 0.995)
    assert np.all(power < 1.0)


@given(permittivity=permittivities)
def test_a_grazing_ray_is_reflected_as_a_whole(permittivity: complex) -> None:
    assert fresnel_power(0.0, permittivity) == pytest.approx(1.0, abs=1e-12)
    if abs(permittivity - 1.0) > 0.01 and abs(permittivity) < 1e4:
        assert fresnel_power(1e-8, permittivity) == pytest.approx(1.0, abs=1e-3)


@given(cosine=cosines, permittivity=permittivities)
def test_energy(cosine: float, permittivity: complex) -> None:
    te, tm = fresnel_coefficients(cosine, permittivity)
    assert abs(te) <= 1.0 + 1e-12
    assert abs(tm) <= 1.0 + 1e-12
    assert 0.0 <= fresnel_power(cosine, permittivity) <= 1.0


@given(cosine=st.floats(1e-3, 1.0), permittivity=permittivities)
def test_the_forward_solver_has_the_same_physics(cosine: float, permittivity: complex) -> None:
    """Two formulas that share no code; where next to nothing is reflected, what is left is rounding."""
    theirs = (np.abs(half_space(np.array([cosine]), np.array([permittivity]))) ** 2).mean()
    assert theirs == pytest.approx(float(fresnel_power(cosine, permittivity)), rel=1e-6, abs=1e-9)


def test_arrays_broadcast() -> None:
    power = fresnel_power(np.array([[1.0], [0.5]]), np.array([2.0, 4.0, 6.0]))
    assert power.shape == (2, 3)
    assert power[1, 2] == fresnel_power(0.5, 6.0)


# Triangles


def test_triangles_without_a_known_material_have_the_constant_loss() -> None:
    materials = ("itu_concrete", "steel", "itu_floorboard")
    walls = half_spaces(face_permittivity(np.array([0, 1, 2, -1], np.int16), materials, 3.5), 7.0)
    faces = np.array([3, 2, 1, 0, 0], np.int32)
    power = 10.0 ** walls.reflected(faces, np.array([0.1, 0.5, 1.0, 1.0, 0.5]))
    concrete = known("concrete", 3.5)
    expected = [10**-0.7] * 3 + [float(fresnel_power(1.0, concrete)), float(fresnel_power(0.5, concrete))]
    np.testing.assert_allclose(power, expected, rtol=1e-13)


def test_no_materials_at_all() -> None:
    np.testing.assert_array_equal(face_permittivity(np.full(3, -1, np.int16), (), 3.5), [np.nan] * 3)
    log_gain = opaque_walls(3, loss_db=6.0).reflected(np.array([0, 2], np.int32), np.ones(2))
    np.testing.assert_allclose(log_gain, -0.1 * 6.0, rtol=1e-12)


def test_vacuum_leaves_a_little() -> None:
    walls = half_spaces(face_permittivity(np.zeros(1, np.int16), ("itu_vacuum",), 3.5), 6.0)
    assert walls.reflected(np.zeros(1, np.int32), np.array([0.7])) == np.log10(ReflectionSettings.min_power)


# Launched rays


def corridor() -> NDArray[np.float64]:
    """Triangles of a floor at z = 0 and a ceiling at z = 2, shape (4, 3, 3), m."""
    floor = np.array([[(-50, -50, 0), (50, -50, 0), (50, 50, 0)], [(-50, -50, 0), (50, 50, 0), (-50, 50, 0)]], float)
    return np.concatenate([floor, floor + np.array([0, 0, 2])])


def test_losses_add_up_along_a_ray(launch_rows: Launch) -> None:
    """A ray at 60 deg from the vertical between a concrete floor and a ceiling of 7 dB: down, up, down."""
    concrete = known("concrete", 3.5)
    walls = half_spaces(np.array([concrete, concrete, np.nan, np.nan]), 7.0)
    heading = np.array([[np.sqrt(0.75), 0.0, -0.5]])
    segments = launch_rows(corridor(), (0, 0.1, 1), heading, max_reflections=3, walls=walls)
    floor = np.log10(fresnel_power(0.5, concrete))
    np.testing.assert_allclose(segments.log_gain, [[0.0, floor, floor - 0.7, 2 * floor - 0.7]], rtol=1e-12)


def test_paths_of_launcher_and_solver_are_alike(launch_rows: Launch, clutter: NDArray[np.float64]) -> None:
    """Each launched ray meets the image method's paths with the same gain: walls, cabinet and table differ."""
    face_materials = np.repeat(np.arange(3), 12).astype(np.int16)
    materials = ("itu_plasterboard", "itu_metal", "oak")
    walls = half_spaces(face_permittivity(face_materials, materials, 3.5), 4.0)
    solver = ForwardSolver.from_mesh(
        clutter.reshape(-1, 3),
        np.arange(108).reshape(-1, 3),
        max_reflections=2,
        reflection_loss_db=4.0,
        walls=SolverWalls.opaque(walls.permittivity, carrier_ghz=3.5),
    )
    station = np.array([3.6, 0.4, 2.6])
    paths = solver.paths(station, np.array([2.1, 2.4, 1.3]))
    heading = np.stack(
        [
            np.sin(paths.zenith) * np.cos(paths.azimuth),
            np.sin(paths.zenith) * np.sin(paths.azimuth),
            np.cos(paths.zenith),
        ],
        axis=1,
    )
    segments = launch_rows(clutter, station, heading, max_reflections=2, walls=walls)
    log_gain = segments.log_gain[np.arange(len(paths)), paths.num_reflections]
    np.testing.assert_allclose(10.0 * log_gain - 20.0 * np.log10(paths.path_length), paths.gain_db, rtol=0, atol=1e-6)
    assert len(paths) > 10
    assert np.all(np.diff(paths.gain_db) <= 0.0)


def test_the_solver_wants_one_permittivity_for_each_face() -> None:
    walls = SolverWalls.opaque(np.array([2.0 + 0j]), carrier_ghz=3.5)
    with pytest.raises(ValueError, match="the walls have 1 faces and the mesh 4"):
        ForwardSolver.from_mesh(corridor().reshape(-1, 3), np.arange(12).reshape(-1, 3), walls=walls)


# Sites


def with_materials(scene: trimesh.Scene, **materials: str) -> trimesh.Scene:
    """Give the scene's objects materials."""
    for name, material in materials.items():
        scene.geometry[name].visual = trimesh.visual.TextureVisuals(material=PBRMaterial(name=material))
    return scene


@pytest.mark.parametrize("reflection", ["constant", "itu"])
def test_the_site_decides(
    tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene, reflection: str
) -> None:
    scene = with_materials(cluttered_scene, room="itu_brick", cabinet="itu_metal", table="itu_wood")
    propagation: dict[str, Any] = {"reflection": reflection, "carrier_ghz": 28.0, "reflection_loss_db": 5.0}
    site = read_site(write_site(tmp_path, scene=scene, propagation=propagation))
    twin = prepare_twin(site, tmp_path)
    assert twin.findings == ()
    walls = scene_walls(site, twin)
    assert not walls.passable.any()
    for n, material in enumerate(twin.scene.materials):
        mine = twin.scene.face_materials == n
        by_name = reflection == "itu"
        np.testing.assert_array_equal(walls.permittivity[mine], known(material, 28.0) if by_name else np.nan)
        np.testing.assert_array_equal(walls.reflection_loss_db[mine], np.nan if by_name else 5.0)


def test_what_the_constant_loss_stands_in_for_is_told(
    tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene
) -> None:
    scene = with_materials(cluttered_scene, cabinet="steel", table="itu_floorboard")
    site = read_site(write_site(tmp_path, scene=scene, propagation={"reflection": "itu"}))
    twin = prepare_twin(site, tmp_path)
    found = sorted(finding.message for finding in twin.findings)
    assert [finding.severity for finding in twin.findings] == ["warning"] * 3
    assert found[0].startswith("12 of 36 triangles have no material: reflection_loss_db is taken; ")
    assert found[1] == (
        "material 'itu_floorboard' is known for 50 to 100 GHz only, not at carrier_ghz = 3.5: reflection_loss_db is "
        "taken; choose another material"
    )
    assert found[2].startswith(
        "material 'steel' unknown: reflection_loss_db is taken; ITU-R P.2040 has vacuum, concrete"
    )
    refuse_errors(twin)


def test_the_solver_of_a_table_has_its_materials(
    tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene
) -> None:
    """And the table is another one: its weights are those of the materials."""
    scene = with_materials(cluttered_scene, room="itu_brick", cabinet="itu_metal", table="steel")
    solvers, tables = {}, {}
    for reflection in ("constant", "itu"):
        path = write_site(tmp_path, scene=scene, propagation={"reflection": reflection}, table={"windows_deg": [20.0]})
        build_table(path, tmp_path / f"{reflection}.h5")
        tables[reflection] = Table.open(tmp_path / f"{reflection}.h5")
        solvers[reflection] = solver_of(tables[reflection])
    assert solvers["constant"].walls is None
    walls = solvers["itu"].walls
    assert walls is not None
    assert not walls.lets_through.any()
    permittivity = walls.permittivity
    materials = {known("brick", 3.5): 12, known("metal", 3.5): 12}
    assert {value: int(np.sum(permittivity == value)) for value in materials} == materials
    assert np.isnan(permittivity).sum() == 12
    assert tables["constant"].table_id != tables["itu"].table_id
    masses = [table.levels("bs1")[0].cell_log_mass for table in tables.values()]
    assert np.abs(masses[0] - masses[1]).max() > 0.01
