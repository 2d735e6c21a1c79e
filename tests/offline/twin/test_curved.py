"""Cells that see a round pillar: joined groups keep the moments, and more facets do not make more of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from rayfix_offline.fit.settings import TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.rays.segments import Sequences
from rayfix_offline.rays.trace import LevelRays, trace_station
from rayfix_offline.site import parse_site
from rayfix_offline.twin.twin import Twin, prepare_twin
from rayfix_tables.mixture import TubeMixture, unpack

STATION = (0.3, 0.4, 2.4)
PILLAR = (2.4, 2.7)
WHOLE = TubeFit(dropped_mass=0.0, max_groups=10_000, max_components=10_000, max_divergence=-1.0)
"""Nothing dropped and nothing merged: a divergence is never negative."""


def pillar_room(folder: Path, facets: int) -> tuple[Twin, LevelRays]:
    """Room of 4 x 5 x 3 m with a round pillar of 0.6 m, traced at a window of 5 deg with two reflections."""
    scene = trimesh.Scene()
    pillar = trimesh.creation.cylinder(radius=0.3, height=2.9, sections=facets)
    pillar.apply_translation((*PILLAR, 1.45))
    room = trimesh.creation.box(bounds=[(0, 0, 0), (4, 5, 3)])
    for name, mesh in (("room", room), ("pillar", pillar)):
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    (folder / f"{facets}.glb").write_bytes(scene.export(file_type="glb"))
    site = parse_site(
        {
            "site": {"name": "room", "scene": f"{facets}.glb"},
            "propagation": {"max_reflections": 2},
            "table": {"windows_deg": [5.0]},
            "stations": [{"id": "bs1", "position_m": list(STATION)}],
        }
    )
    twin = prepare_twin(site, folder)
    return twin, trace_station(site.stations[0], site, twin).finest


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> dict[int, tuple[Twin, LevelRays]]:
    """Rooms by their number of facets."""
    folder = tmp_path_factory.mktemp("curved")
    return {facets: pillar_room(folder, facets) for facets in (96, 768)}


def facing(level: LevelRays) -> NDArray[np.float64]:
    """Centres of cells that look at the pillar."""
    azimuth = np.arctan2(PILLAR[1] - STATION[1], PILLAR[0] - STATION[0])
    zeniths = (1.6, 1.75, 1.9)
    return np.array([(azimuth + turn, zenith) for turn in (-0.06, 0.0, 0.06) for zenith in zeniths])


def each_facet(level: LevelRays) -> LevelRays:
    """Return the same rays with every facet as a surface by itself."""
    return replace(level, surface_sequences=np.arange(len(level.sequences.images)))


def moments(mixture: TubeMixture) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and covariance of the places of a cell."""
    weight = np.exp(mixture.log_weight.astype(np.float64))
    weight /= weight.sum()
    mean = mixture.x_mean.astype(np.float64)
    middle = weight @ mean
    slope = mixture.jacobian.astype(np.float64)
    cov = unpack(mixture.x_cov).astype(np.float64) + slope @ unpack(mixture.u_cov) @ np.swapaxes(slope, 1, 2)
    off = mean - middle
    return middle, np.einsum("n,nij->ij", weight, cov + off[:, :, None] * off[:, None, :])


def surfaces_on_the_way(sequences: Sequences, planes_surface: NDArray[np.int32], number: int) -> tuple[int, ...]:
    """Surfaces of a sequence, in order."""
    way: list[int] = []
    while number > 0:
        way.append(int(planes_surface[sequences.planes[number]]))
        number = int(sequences.parents[number])
    return tuple(reversed(way))


def test_sequences_over_the_same_surfaces(traced: dict[int, tuple[Twin, LevelRays]]) -> None:
    """Each names the first one that takes the same way, found here by following the ways."""
    twin, level = traced[96]
    sequences = level.sequences
    assert len(np.unique(twin.planes.surfaces)) < len(twin.planes)
    first: dict[tuple[int, ...], int] = {}
    for number in range(len(sequences.images)):
        way = surfaces_on_the_way(sequences, twin.planes.surfaces, number)
        assert level.surface_sequences[number] == first.setdefault(way, number)
    assert len(first) < 0.7 * len(sequences.images)


def test_joining_keeps_masses_and_moments(traced: dict[int, tuple[Twin, LevelRays]]) -> None:
    _, level = traced[96]
    centres = facing(level)
    together = fit_tubes(centres, level, WHOLE)
    each = fit_tubes(centres, each_facet(level), WHOLE)
    np.testing.assert_allclose(together[1], each[1], rtol=0, atol=1e-12)
    assert np.all(together[0] < 0.8 * each[0])
    starts = [np.concatenate([[0], np.cumsum(counts)]) for counts in (together[0], each[0])]
    for n in range(len(centres)):
        (mean, cov), (its_mean, its_cov) = (
            moments(fitted[2][int(start[n]) : int(start[n + 1])])
            for fitted, start in zip((together, each), starts, strict=True)
        )
        np.testing.assert_allclose(mean, its_mean, rtol=0, atol=1e-5)  # m; the table holds single precision
        # Joined groups are blurred by the mean of their mirrors: a share of the width of a ray, squared.
        np.testing.assert_allclose(cov, its_cov, rtol=0, atol=1e-3)


def test_more_facets_do_not_make_more_groups(traced: dict[int, tuple[Twin, LevelRays]]) -> None:
    groups, apart, components = (
        {facets: int(fit_tubes(facing(level), change(level), fit)[0].sum()) for facets, (_, level) in traced.items()}
        for change, fit in ((lambda level: level, WHOLE), (each_facet, WHOLE), (lambda level: level, TubeFit()))
    )
    assert apart[768] > 2.0 * apart[96]
    assert groups[768] < 1.15 * groups[96]
    assert components[768] < 1.15 * components[96]
