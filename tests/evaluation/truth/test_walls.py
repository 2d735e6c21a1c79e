"""Walls that let signals through: slabs, sheets and closed parts, beside closed forms and a naive count."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_evaluation.drops.bound import path_gradients
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_evaluation.truth.fresnel import excess_length, half_space, slab
from rayfix_evaluation.truth.interactions import Polarisation
from rayfix_evaluation.truth.walls import Walls
from tests.support.scenes.shapes import box, quad

Array = NDArray[np.float64]

CARRIER = 3.5
WAVELENGTH = 299792458.0 / 3.5e9
CONCRETE = 5.24 - 0.632j
"""About that of ITU-R P.2040 at 3.5 GHz."""

cosines = st.floats(0.02, 1.0)
lossless = st.floats(1.1, 10.0)
thicknesses = st.floats(0.001, 0.5)


def slab_of(
    cosine: float, permittivity: complex, thickness: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Coefficients of one slab, each of shape (2,)."""
    found = slab(np.array([cosine]), np.array([permittivity], np.complex128), np.array([thickness]), CARRIER)
    return found[0][0], found[1][0]


def by_transfer_matrix(
    cosine: float, permittivity: complex, thickness: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Coefficients from the matrix that takes the tangential fields through the slab (Born and Wolf, section 1.6)."""
    inner = np.sqrt(permittivity - 1.0 + cosine**2 + 0j)
    phase = 2.0 * np.pi * thickness / WAVELENGTH * inner
    reflected, transmitted = [], []
    # Admittance of the tangential fields, outside and inside.
    for outside, inside in ((cosine, inner), (1.0 / cosine, permittivity / inner)):
        matrix = np.array([[np.cos(phase), 1j * np.sin(phase) / inside], [1j * inside * np.sin(phase), np.cos(phase)]])
        electric, magnetic = matrix @ np.array([1.0, outside])
        reflected.append((outside * electric - magnetic) / (outside * electric + magnetic))
        transmitted.append(2.0 * outside / (outside * electric + magnetic))
    # The tangential field of the parallel polarisation keeps its sign where the field along (ray x normal) turns.
    return np.array(reflected) * [1.0, -1.0], np.array(transmitted)


@given(cosine=cosines, permittivity=lossless, loss=st.floats(0.0, 1.0), thickness=thicknesses)
def test_slabs_are_those_of_transfer_matrices(
    cosine: float, permittivity: float, loss: float, thickness: float
) -> None:
    ours = slab_of(cosine, permittivity - 1j * loss, thickness)
    theirs = by_transfer_matrix(cosine, permittivity - 1j * loss, thickness)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-7, atol=1e-9)


@given(cosine=cosines, permittivity=lossless, thickness=thicknesses)
def test_slabs_without_loss_keep_the_energy(cosine: float, permittivity: float, thickness: float) -> None:
    reflected, transmitted = slab_of(cosine, complex(permittivity), thickness)
    np.testing.assert_allclose(np.abs(reflected) ** 2 + np.abs(transmitted) ** 2, 1.0, rtol=1e-9)


def test_half_a_wave_is_a_window_and_much_loss_a_half_space() -> None:
    reflected, transmitted = slab_of(1.0, 4.0 + 0j, 0.25 * WAVELENGTH)
    np.testing.assert_allclose(np.abs(reflected), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(transmitted), 1.0, atol=1e-9)
    reflected, transmitted = slab_of(0.7, CONCRETE, 3.0)
    np.testing.assert_allclose(reflected, half_space(np.array([0.7]), np.array([CONCRETE]))[0], rtol=1e-9)
    assert np.abs(transmitted).max() < 1e-6


@given(permittivity=lossless, thickness=thicknesses, cosine=cosines)
def test_excess_length_follows_the_refracted_ray(permittivity: float, thickness: float, cosine: float) -> None:
    """Trace it: the optical length to a plane across the ray beyond the slab, with the slab and without."""
    sine = np.sqrt(1.0 - cosine**2)
    inner = np.arcsin(sine / np.sqrt(permittivity))
    exit_with, exit_without = thickness * np.tan(inner), thickness * sine / cosine
    optical = np.sqrt(permittivity) * thickness / np.cos(inner) + (exit_without - exit_with) * sine
    found = excess_length(np.array([cosine]), np.array([permittivity + 0j]), np.array([thickness]))
    assert found[0] == pytest.approx(optical - thickness / cosine, rel=1e-6, abs=1e-12)


def solver_of(
    triangles: Array,
    *,
    solid: NDArray[np.int32] | int = -1,
    permittivity: complex | NDArray[np.complex128] = CONCRETE,
    thickness: float | Array = 0.1,
    max_reflections: int = 2,
    polarisation: Polarisation = "mixed",
    excess: bool = True,
) -> ForwardSolver:
    """Solver of triangles that let signals through."""
    count = len(triangles)
    walls = Walls.sheets(
        np.broadcast_to(permittivity, count).astype(np.complex128),
        np.broadcast_to(thickness, count).astype(np.float64),
        carrier_ghz=CARRIER,
    )
    walls = replace(walls, solid=np.broadcast_to(solid, count).astype(np.int32), excess_length=excess)
    return ForwardSolver.from_mesh(
        triangles.reshape(-1, 3),
        np.arange(3 * count).reshape(-1, 3),
        max_reflections=max_reflections,
        walls=walls,
        polarisation=polarisation,
    )


def mean_db(coefficients: NDArray[np.complex128]) -> float:
    return float(10.0 * np.log10((np.abs(coefficients) ** 2).mean()))


WALL = quad((2, -9, -9), (2, 9, -9), (2, 9, 9), (2, -9, 9))


def test_a_sheet_in_the_way() -> None:
    """Straight through at 30 deg: gain, length, place and direction; and it is no line of sight."""
    end = np.array([4.0, 4.0 / np.sqrt(3.0), 0.0])
    solver = solver_of(WALL, max_reflections=0)
    paths = solver.paths((0, 0, 0), end)
    distance = np.linalg.norm(end)
    cosine = np.sqrt(0.75)
    assert (paths.num_reflections.tolist(), paths.num_walls.tolist()) == ([0], [1])
    assert not paths.line_of_sight[0]
    assert not solver.line_of_sight((0, 0, 0), [end])[0]
    expected = -20.0 * np.log10(distance) + mean_db(slab_of(cosine, CONCRETE, 0.1)[1])
    assert paths.gain_db[0] == pytest.approx(expected, abs=1e-9)
    assert paths.path_length[0] == pytest.approx(distance + 0.1 * (np.sqrt(5.24 - 0.25) - cosine), abs=1e-9)
    np.testing.assert_allclose(paths.crossings[0, 0], end / 2, atol=1e-9)
    assert paths.azimuth[0] == pytest.approx(np.deg2rad(30.0))
    plain = solver_of(WALL, max_reflections=0, excess=False).paths((0, 0, 0), end)
    assert plain.path_length[0] == pytest.approx(distance, abs=1e-12)
    # The bound: one metre across the direction turns the angle by the distance, which no slab changes.
    np.testing.assert_allclose(path_gradients(paths, 0)[0], [-0.5 / distance, cosine / distance, 0.0], atol=1e-12)


def test_a_fifth_of_a_metre_of_concrete() -> None:
    """A range through it is 0.26 m longer than the distance."""
    paths = solver_of(WALL, thickness=0.2, max_reflections=0).paths((0, 0, 0), (5, 0, 0))
    assert paths.path_length[0] - 5.0 == pytest.approx(0.2 * (np.sqrt(5.24) - 1.0), abs=1e-12)
    assert paths.path_length[0] - 5.0 == pytest.approx(0.258, abs=0.001)


def test_reflection_takes_the_slab_into_account() -> None:
    paths = solver_of(WALL, max_reflections=1).paths((0, 1, 0), (0, -1, 0))
    cosine = 2.0 / np.sqrt(5.0)
    reflected = slab_of(cosine, CONCRETE, 0.1)[0]
    assert paths.num_reflections.tolist() == [0, 1]
    assert paths.gain_db[1] == pytest.approx(-20 * np.log10(2 * np.sqrt(5.0)) + mean_db(reflected), abs=1e-9)


def test_a_closed_part_is_one_wall_of_its_own_thickness() -> None:
    """A block of 0.3 m beside the sheet of the same thickness, straight and reflected; nothing echoes inside."""
    block = box((2.0, -9, -9), (2.3, 9, 9))
    solver = solver_of(block, solid=0, thickness=0.05)
    sheet = solver_of(WALL, thickness=0.3)
    station, end, beside = np.array([0.0, 0.5, 0.2]), np.array([4.0, 1.5, -0.4]), np.array([0.4, -2.0, 0.3])
    for point in (end, beside):
        ours, expected = solver.paths(station, point), sheet.paths(station, point)
        assert len(ours) == len(expected) > 0
        np.testing.assert_allclose(ours.gain_db, expected.gain_db, atol=1e-9)
        np.testing.assert_allclose(ours.path_length, expected.path_length, atol=1e-9)
        np.testing.assert_array_equal(ours.num_walls, expected.num_walls)
    assert solver.paths(station, end).num_walls.tolist() == [1]


def test_through_a_corner_of_a_closed_part() -> None:
    """Entered at one side and left at another: the slab reaches as far as the ray does, along the entered normal."""
    solver = solver_of(box((0, 0, -5), (4, 4, 5)), solid=0, max_reflections=0)
    start, end = np.array([-0.5, 2.5, 0.0]), np.array([2.5, 5.5, 0.0])
    paths = solver.paths(start, end)
    np.testing.assert_allclose(paths.crossings[0, 0], [0.0, 3.0, 0.0], atol=1e-9)
    expected = slab_of(np.sqrt(0.5), CONCRETE, 1.0)[1]
    assert paths.gain_db[0] + 20 * np.log10(np.linalg.norm(end - start)) == pytest.approx(mean_db(expected), abs=1e-9)


def test_closed_parts_that_touch_are_two_walls() -> None:
    """Blocks of 0.1 and 0.2 m with a common plane; and a station that is built into the first."""
    blocks = np.concatenate([box((2.0, -9, -9), (2.1, 9, 9)), box((2.1, -9, -9), (2.3, 9, 9))])
    solver = solver_of(blocks, solid=np.repeat([0, 1], 12).astype(np.int32), max_reflections=0)
    paths = solver.paths((0, 0, 0), (5, 0, 0))
    single = [mean_db(slab_of(1.0, CONCRETE, d)[1]) for d in (0.1, 0.2)]
    assert paths.num_walls.tolist() == [2]
    assert paths.gain_db[0] + 20 * np.log10(5.0) == pytest.approx(sum(single), abs=1e-9)
    inside = solver.paths((2.04, 0, 0), (5, 0, 0))
    part = mean_db(slab_of(1.0, CONCRETE, 0.06)[1]) + single[1]
    assert inside.num_walls.tolist() == [2]
    assert inside.gain_db[0] + 20 * np.log10(2.96) == pytest.approx(part, abs=1e-9)


def naive_walls(start: Array, end: Array, sheets: list[Array]) -> list[int]:
    """Sheets that a segment crosses strictly between its ends (Moeller and Trumbore)."""
    found = []
    for n, triangles in enumerate(sheets):
        along = end - start
        e1, e2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        p = np.cross(along, e2)
        det = np.einsum("fi,fi->f", e1, p)
        s = start - triangles[:, 0]
        u = np.einsum("fi,fi->f", s, p) / det
        q = np.cross(s, e1)
        v = q @ along / det
        t = np.einsum("fi,fi->f", e2, q) / det
        if ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6) & (t < 1 - 1e-6)).any():
            found.append(n)
    return found


@pytest.mark.parametrize("seed", range(3))
def test_every_path_passes_the_sheets_in_its_way(seed: int) -> None:
    """Tilted sheets of different materials: every segment's crossings and every path's gain, sheet by sheet."""
    rng = np.random.default_rng(seed)
    sheets, permittivity, thickness = [], rng.uniform(2, 7, 8) - 1j * rng.uniform(0, 0.5, 8), rng.uniform(0.01, 0.2, 8)
    for _ in range(8):
        frame = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        centre = rng.uniform(-2, 2, 3)
        corners = [centre + a * frame[0] + b * frame[1] for a, b in ((-2, -2), (2, -2), (2, 2), (-2, 2))]
        sheets.append(quad(*corners))
    solver = solver_of(
        np.concatenate(sheets), permittivity=np.repeat(permittivity, 2), thickness=np.repeat(thickness, 2)
    )
    normals = np.array([np.cross(t[0, 1] - t[0, 0], t[0, 2] - t[0, 0]) for t in sheets])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    passed = 0
    for _ in range(4):
        station, point = rng.uniform(-3, 3, (2, 3))
        paths = solver.paths(station, point)
        assert len(paths) > 0
        for i in range(len(paths)):
            corners = paths.vertices[i, : paths.num_reflections[i] + 2]
            gain, walls, excess = -20.0 * np.log10(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()), 0, 0.0
            mirrors = [
                int(np.abs(((hit - [t[0, 0] for t in sheets]) * normals).sum(axis=1)).argmin()) for hit in corners[1:-1]
            ]
            for k, (start, end) in enumerate(itertools.pairwise(corners)):
                ray = (end - start) / np.linalg.norm(end - start)
                for n in naive_walls(start, end, sheets):
                    if n in mirrors[max(k - 1, 0) : k + 1]:
                        continue
                    cosine = abs(ray @ normals[n])
                    gain += mean_db(by_transfer_matrix(cosine, permittivity[n], thickness[n])[1])
                    excess += thickness[n] * (np.sqrt(permittivity[n].real - 1 + cosine**2) - cosine)
                    walls += 1
                if k < len(mirrors):
                    n = mirrors[k]
                    gain += mean_db(by_transfer_matrix(abs(ray @ normals[n]), permittivity[n], thickness[n])[0])
            unfolded = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
            assert paths.num_walls[i] == walls
            assert paths.gain_db[i] == pytest.approx(gain, abs=1e-6)
            assert paths.path_length[i] == pytest.approx(unfolded + excess, abs=1e-9)
            passed += walls
    assert passed > 20


def test_paths_are_the_same_both_ways() -> None:
    rng = np.random.default_rng(3)
    room = box((0, 0, 0), (6, 5, 3))
    screens = np.concatenate([quad((x, 0, 0), (x, 4, 0), (x, 4, 3), (x, 0, 3)) for x in (1.7, 3.1, 4.6)])
    solver = solver_of(np.concatenate([room, screens]), thickness=0.05)
    for _ in range(4):
        a, b = rng.uniform((0.2, 0.2, 0.2), (5.8, 4.8, 2.8), (2, 3))
        there, back = solver.paths(a, b), solver.paths(b, a)
        np.testing.assert_allclose(there.gain_db, back.gain_db, atol=1e-9)
        np.testing.assert_array_equal(np.sort(there.num_walls), np.sort(back.num_walls))
        assert there.num_walls.max() >= 2


def test_a_kept_polarisation_differs_after_two_walls() -> None:
    """One interaction: the mean of both. Two with one plane of incidence: the mean of the products."""
    two = np.concatenate([WALL, WALL + np.array([1.0, 0, 0])])
    end = (4.0, 4.0, 0.0)
    power = np.abs(slab_of(np.sqrt(0.5), CONCRETE, 0.1)[1]) ** 2
    free = -20.0 * np.log10(np.sqrt(32.0))
    for triangles, exponent in ((WALL, 1), (two, 2)):
        mixed = solver_of(triangles, max_reflections=0).paths((0, 0, 0), end)
        kept = solver_of(triangles, max_reflections=0, polarisation="kept").paths((0, 0, 0), end)
        assert mixed.gain_db[0] - free == pytest.approx(10 * exponent * np.log10(power.mean()), abs=1e-9)
        assert kept.gain_db[0] - free == pytest.approx(10 * np.log10((power**exponent).mean()), abs=1e-9)
    assert kept.gain_db[0] > mixed.gain_db[0] + 0.05


def test_constant_losses_and_opaque_faces() -> None:
    """A wall of 5 dB through and 9 dB back has no excess length; an opaque one keeps blocking, metal too."""
    walls = replace(
        Walls.opaque(np.array([np.nan + 0j, np.nan + 0j]), carrier_ghz=CARRIER),
        transmission_loss_db=np.full(2, 5.0),
        reflection_loss_db=np.full(2, 9.0),
    )
    solver = ForwardSolver.from_mesh(WALL.reshape(-1, 3), np.arange(6).reshape(-1, 3), max_reflections=1, walls=walls)
    through = solver.paths((0, 0, 0), (4, 0, 0))
    assert through.gain_db[0] == pytest.approx(-20 * np.log10(4.0) - 5.0)
    assert through.path_length[0] == 4.0
    back = solver.paths((0, 1, 0), (0, -1, 0))
    assert back.gain_db[1] == pytest.approx(-20 * np.log10(2 * np.sqrt(5.0)) - 9.0)
    closed = replace(walls, transmission_loss_db=np.full(2, np.inf))
    blocked = ForwardSolver.from_mesh(WALL.reshape(-1, 3), np.arange(6).reshape(-1, 3), walls=closed)
    assert len(blocked.paths((0, 0, 0), (4, 0, 0))) == 0


def test_weak_paths_are_left_out() -> None:
    station, end = (0, 1, 0), (0.5, -1, 0)
    everything = solver_of(WALL, max_reflections=1).paths(station, end)
    solver = replace(solver_of(WALL, max_reflections=1), max_loss_db=3.0)
    assert len(everything) == 2
    assert solver.paths(station, end).num_reflections.tolist() == [0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thickness": np.full(3, 0.1)}, "one value for each face"),
        ({"thickness": np.full(2, -0.1)}, "thickness has negative values"),
        ({"carrier_ghz": 0.0}, "carrier_ghz is 0.0"),
    ],
)
def test_walls_that_do_not_fit_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(Walls.opaque(np.full(2, 4.0 + 0j), carrier_ghz=CARRIER), **change)
