"""Two traces of one station compared: by a plain NumPy twin, by geometry, and by what a change can do to a cell."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_offline.fit.settings import RayFit, TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.job.changes import SMALLEST, cell_changes, ray_changes
from rayfix_offline.rays.pathprior import fill_path_prior
from rayfix_offline.rays.pieces import cut_pieces
from rayfix_offline.rays.rays import RaySet, sample_rays
from rayfix_offline.rays.segments import Segments
from rayfix_offline.rays.trace import LevelRays
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.geometry.angles import tangent
from rayfix_tables.grid import AngularGrid
from tests.support.scenes.rooms import CABINET, ROOM
from tests.support.scenes.shapes import box

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
Launch = Callable[..., Segments]

CRATE: Box = ((2.4, 2.8, 0.0), (3.0, 3.4, 0.7))
MOVED: Box = ((2.4, 3.5, 0.0), (3.0, 4.1, 0.7))
STATION = np.array([3.6, 0.4, 2.6])
WINDOW = 0.15


@dataclass(frozen=True)
class Traced:
    """A level with the segments that it was cut from."""

    level: LevelRays
    segments: Segments


@pytest.fixture(scope="module")
def trace(launch_in: Launch) -> Callable[..., Traced]:
    """Return a function that traces the station among boxes."""
    rays = sample_rays(0.05, np.random.default_rng(0))

    def run(*boxes: Box, kind: str = "power", order: NDArray[np.int64] | None = None) -> Traced:
        triangles = np.concatenate([box(*b) for b in (ROOM, *boxes)])
        if order is not None:
            triangles = triangles[order]
        segments = launch_in(triangles, STATION, rays.directions, max_reflections=2)
        free = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=np.ones((40, 50, 30), bool))
        prior = fill_path_prior(rays, segments, free, exponent=2.0, refinement=2)
        pieces = cut_pieces(rays, segments, prior, exponent=2.0, kind=kind, slice_ratio=1.2)
        level = LevelRays(
            window=WINDOW,
            grid=AngularGrid.from_spacing(WINDOW / 0.8),
            rays=rays,
            ray_spacing=0.05,
            pieces=pieces,
            sequences=segments.sequences,
            surface_sequences=np.arange(len(segments.sequences.images)),
        )
        return Traced(level, segments)

    return run


def rays_of(level: LevelRays, cell: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rays within a cell's window, and their weight."""
    rays: RaySet = level.rays
    at = tangent(rays.azimuth, rays.zenith, *level.grid.centres[cell])
    square = (at**2).sum(axis=1) / level.window**2
    inside = np.flatnonzero(square <= RayFit.cutoff**2)
    return inside, np.exp(-0.5 * square[inside]) * rays.solid_angle[inside]


def naive_change(old: LevelRays, new: LevelRays, ray: int) -> tuple[float, float]:
    """Change and new mass of a ray, from dictionaries of its pieces by course and slice."""
    found = []
    for level in (old, new):
        pieces, sequences = level.pieces, level.sequences
        table = {}
        for p in range(pieces.offsets[ray], pieces.offsets[ray + 1]):
            course = np.round(np.append(sequences.images[pieces.sequence[p]], sequences.mirrors[pieces.sequence[p]]), 3)
            key = (*(course + 0.0).tolist(), int(pieces.slice[p]))
            table[key] = (pieces.mass[p], pieces.mean[p], pieces.variance[p])
        found.append(table)
    a, b = found
    change = sum(a[key][0] for key in a.keys() - b.keys()) + sum(b[key][0] for key in b.keys() - a.keys())
    for key in a.keys() & b.keys():
        (ma, la, va), (mb, lb, vb) = a[key], b[key]
        change += abs(ma - mb)
        if la != lb and min(ma, mb) > 0.0:
            deviation = np.sqrt(max(va, vb))
            change += min(ma, mb) * (min(2.0, abs(la - lb) / deviation) if deviation > 0.0 else 2.0)
    return change, sum(m for m, _, _ in b.values())


@pytest.mark.parametrize("kind", ["power", "uniform", "paper"])
def test_an_unchanged_scene_changes_nothing(trace: Callable[..., Traced], kind: str) -> None:
    old, new = (trace(CABINET, CRATE, kind=kind).level for _ in range(2))
    assert not cell_changes(old, new).any()


@pytest.mark.parametrize("kind", ["power", "uniform"])
def test_cells_agree_with_a_plain_twin(trace: Callable[..., Traced], kind: str) -> None:
    old, new = trace(CABINET, CRATE, kind=kind).level, trace(CABINET, MOVED, kind=kind).level
    found = cell_changes(old, new)
    rng = np.random.default_rng(1)
    checked = 0
    for cell in rng.choice(np.flatnonzero(np.isfinite(found)), 25, replace=False):
        inside, weight = rays_of(new, cell)
        change, mass = np.array([naive_change(old, new, ray) for ray in inside]).T
        assert found[cell] == pytest.approx((weight @ change) / (weight @ mass), rel=1e-9, abs=SMALLEST)
        checked += change.any()
    assert checked > 10


def crosses(segments: Segments, directions: NDArray[np.float64], box: Box) -> NDArray[np.bool_]:
    """Whether rays come to a box: the slab method on each of their straight stretches."""
    sequences, sequence = segments.sequences, segments.sequence
    heading = np.einsum("nij,nj->ni", sequences.mirrors[sequence], directions[segments.ray])
    with np.errstate(divide="ignore"):
        low, high = ((np.array(corner) - sequences.images[sequence]) / heading for corner in box)
    enter = np.maximum(np.minimum(low, high).max(axis=1), segments.start)
    leave = np.minimum(np.maximum(low, high).min(axis=1), segments.end)
    return np.bincount(segments.ray, weights=enter <= leave + 1e-9, minlength=len(directions)) > 0


def test_exactly_the_rays_that_meet_a_moved_object_change(trace: Callable[..., Traced]) -> None:
    """With weights that do not depend on other paths, nothing else has an effect."""
    old, new = trace(CABINET, CRATE, kind="uniform"), trace(CABINET, MOVED, kind="uniform")
    change, _, same = ray_changes(old.level, new.level)
    directions = new.level.rays.directions
    met = crosses(old.segments, directions, CRATE) | crosses(new.segments, directions, MOVED)
    assert np.array_equal(same, ~met)
    assert np.array_equal(change > 0.0, met)
    assert 0.02 < met.mean() < 0.5
    cells = cell_changes(old.level, new.level)
    for cell in range(len(cells)):
        assert (cells[cell] == 0.0) == (not met[rays_of(new.level, cell)[0]].any())


def test_an_object_that_no_ray_can_reach_changes_nothing(trace: Callable[..., Traced]) -> None:
    hidden: Box = ((0.7, 1.3, 0.3), (1.0, 1.6, 0.9))  # in the cabinet
    old, new = trace(CABINET).level, trace(CABINET, hidden).level
    assert not cell_changes(old, new).any()


def test_the_order_of_triangles_does_not_matter(trace: Callable[..., Traced]) -> None:
    order = np.random.default_rng(2).permutation(36)
    old, new = trace(CABINET, CRATE).level, trace(CABINET, CRATE, order=order).level
    assert cell_changes(old, new).max() < 1e-9


@pytest.mark.parametrize("kind", ["power", "uniform"])
def test_a_cells_mass_changes_by_no_more_than_its_change(trace: Callable[..., Traced], kind: str) -> None:
    old, new = trace(CABINET, CRATE, kind=kind).level, trace(CABINET, MOVED, kind=kind).level
    change = cell_changes(old, new)
    before, after = (np.exp(fit_tubes(lv.grid.centres, lv, TubeFit())[1]) for lv in (old, new))
    assert np.all(np.abs(after - before) <= change * after * (1.0 + 1e-9))
    # The bound is one on the densities, of which masses show only a part.
    assert np.median(change) < 0.2


def test_facets_that_are_gathered_in_another_way_are_not_the_same(trace: Callable[..., Traced]) -> None:
    """The rays are, but the fit is another."""
    level = trace(CABINET, CRATE).level
    sequences = level.sequences
    once = np.flatnonzero(sequences.num_reflections == 1)[:2]
    gathered = np.arange(len(sequences.images))
    gathered[once[1]] = once[0]
    other = replace(level, surface_sequences=gathered)
    numbers = np.arange(len(gathered))[::-1]
    for old, new in ((level, other), (other, level)):
        _, _, same = ray_changes(old, new)
        for ray in range(len(level.rays)):
            pieces = level.pieces.sequence[level.pieces.offsets[ray] : level.pieces.offsets[ray + 1]]
            assert same[ray] == (not np.isin(pieces, once).any())
    renumbered = replace(level, surface_sequences=numbers)
    assert ray_changes(level, renumbered)[2].all()


def test_rays_of_other_directions_have_all_changed(trace: Callable[..., Traced]) -> None:
    old = trace(CABINET).level
    for seed, spacing in ((3, 0.05), (0, 0.06)):
        rays = sample_rays(spacing, np.random.default_rng(seed))
        assert np.all(np.isinf(cell_changes(old, replace(old, rays=rays))))
