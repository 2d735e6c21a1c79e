"""Where a fix may place the target: in the free space, whatever the report says."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.costly_reports import random_measurement, random_report
from rayfix_service.fusion.measurements.report import Height, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.posterior.modes import find_modes
from rayfix_service.fusion.posterior.voxels import nearest_free
from rayfix_service.fusion.stopping import NEVER
from rayfix_service.locator import Locator
from rayfix_tables.errors import ReportError
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.table import Table


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    found = Locator(Table.open(hall_table_path))
    found.warm_up()
    return found


def assert_sound(fix: Fix, free_space: FreeSpace) -> None:
    assert math.isfinite(fix.log_evidence)
    total = sum(candidate.probability for candidate in fix.candidates)
    assert total <= 1.0 + 1e-9
    if fix.regions is not None:
        # Candidates less probable than a thousandth are not told, nor are the least hypotheses.
        assert total == pytest.approx(fix.regions.share, abs=0.03 + 1e-3 * 20)
    for candidate in fix.candidates:
        assert np.isfinite(candidate.position).all()
        assert np.isfinite(candidate.covariance).all()
        assert np.linalg.eigvalsh(candidate.covariance)[0] > 0.0
        assert free_space.contains(candidate.position), (fix.status, candidate.position)


def locate_many(locator: Locator, count: int, seed: int) -> list[Fix]:
    """Locate reports of all kinds that take no longer than some milliseconds, most of them with a height."""
    rng = np.random.default_rng(seed)
    stations = [station.id for station in locator.table.site.stations]
    fixes = []
    while len(fixes) < count:
        report = random_report(rng, stations, most=6)
        if rng.random() < 0.5:
            report = Report(measurements=(random_measurement(rng, stations),))
        if rng.random() < 0.6:
            report = replace(
                report, height=Height(z=float(rng.uniform(-1.5, 4.5)), stdev=float(rng.uniform(0.05, 1.0)))
            )
        if locator.seconds(report) > 0.02:
            continue
        try:
            fixes.append(locator.locate(report))
        except ReportError:
            continue
    return fixes


@pytest.mark.slow
def test_positions_of_very_many_reports_lie_in_the_free_space(locator: Locator) -> None:
    """Means of hypotheses lay in walls or outside with a known height there, of inconsistent fixes above all."""
    fixes = locate_many(locator, 10_000, 2)
    for fix in fixes:
        assert_sound(fix, locator.table.scene.free_space)
    assert {fix.status for fix in fixes} == {"ok", "ambiguous", "inconsistent", "insufficient"}


def test_a_mode_far_from_all_free_space_is_told_where_that_begins() -> None:
    r"""The nearest free voxel is where the target may be.

    Two narrow Gaussians are 3 m above and 2 m beside the only free voxels, and one is within them::

    z   2.0     o                 5 voxels of 0.2 m each way are free, from (1, 1, 1)
        1.0 |####|      o
        0   +---------------- x
    """
    free = np.zeros((20, 20, 20), np.bool_)
    free[5:10, 5:10, 5:10] = True
    space = FreeSpace(origin=np.zeros(3), voxel_size=0.2, free=free)
    mean = np.array([[1.5, 1.5, 5.0], [4.0, 1.5, 1.5], [1.5, 1.5, 1.5]])
    cov = np.broadcast_to(0.01 * np.eye(3), (3, 3, 3)).copy()
    weight = np.array([0.5, 0.3, 0.2])
    probability, position, moment, _ = find_modes(
        np.log(weight), mean, cov, space.origin, space.voxel_size, free, NEVER.cell
    )
    np.testing.assert_allclose(probability, weight, rtol=0, atol=1e-12)
    np.testing.assert_allclose(position, [[1.5, 1.5, 2.0], [2.0, 1.5, 1.5], [1.5, 1.5, 1.5]], rtol=0, atol=1e-6)
    assert space.contains(position).all()
    # The covariance is about the place that is told.
    np.testing.assert_allclose(moment[0], np.diag([0.01, 0.01, 9.01]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_free_place_is_that_of_all_voxels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    free = rng.random((13, 30, 9)) < rng.choice([0.002, 0.05, 0.5])
    free[3, 4, 5] = True
    space = FreeSpace(origin=rng.normal(size=3), voxel_size=0.25, free=free)
    position = space.origin + rng.uniform(-4.0, 12.0, 3)
    root = rng.normal(size=(3, 3)) * rng.uniform(0.05, 3.0, 3)
    cov = root @ root.T + 1e-3 * np.eye(3)
    low = space.origin + space.voxel_size * np.argwhere(free)
    apart = np.clip(position, low + 2.5e-7, low + space.voxel_size - 2.5e-7) - position
    square = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(cov), apart)
    found = position.copy()
    assert nearest_free(found, cov, space.origin, space.voxel_size, free)
    assert space.contains(found)
    np.testing.assert_allclose(found, position + apart[np.argmin(square)], rtol=0, atol=1e-9)


def test_without_any_free_voxel_a_place_stays() -> None:
    position = np.array([1.0, 2.0, 3.0])
    assert not nearest_free(position, np.eye(3), np.zeros(3), 0.5, np.zeros((4, 4, 4), np.bool_))
    np.testing.assert_array_equal(position, [1.0, 2.0, 3.0])


@pytest.mark.parametrize("z", [-4.0, 9.0])
def test_a_height_outside_the_building_is_refused(locator: Locator, z: float) -> None:
    rng = np.random.default_rng(3)
    report = Report(measurements=(random_measurement(rng, ["bs1"]),), height=Height(z=z, stdev=0.5))
    with pytest.raises(ReportError, match=r"the free space lies from .* give a height there") as refusal:
        locator.locate(report)
    assert refusal.value.path == ("height",)
