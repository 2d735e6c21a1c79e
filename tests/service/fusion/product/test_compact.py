"""Compact components answer like what they are expanded to, and nearly like what they were rounded from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rayfix_service.fusion.measurements.directions import NO_DIRECTION, Direction
from rayfix_service.fusion.measurements.line_of_sight import LineOfSightWeights
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.locator import Locator
from rayfix_tables.part import StationPart
from tests.support.messages.hand_reports import EXACT, TUBES, differences, measured, report_of
from tests.support.tables.compact_copies import compact_copy
from tests.support.tables.hand_tables import table_of
from tests.support.tables.random_tables import compact_content


def towards(azimuth: float, zenith: float, stdev: float) -> Direction:
    return Direction(azimuth=azimuth, zenith=zenith, cov=np.diag([stdev**2, stdev**2]))


def parts(seed: int) -> tuple[StationPart, StationPart]:
    """Make a station's compact part, balanced at the finer level, and the same in double precision."""
    part = compact_content(seed, num_stations=1, max_components=5).parts[0]
    assert len(part.levels[0].log_balance) > 0
    return part, replace(part, levels=tuple(level.expanded for level in part.levels))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("stdev", [0.01, 0.1, 0.3, 0.6])
def test_a_direction_has_the_gaussians_of_the_expanded_components(seed: int, stdev: float) -> None:
    compact, whole = (StationMixtures(part) for part in parts(seed))
    rng = np.random.default_rng(seed)
    total = 0
    for _ in range(5):
        direction = towards(rng.uniform(-3.0, 3.0), rng.uniform(0.2, 2.9), stdev)
        ours, theirs = compact.towards(direction), whole.towards(direction)
        np.testing.assert_allclose(ours.log_evidence, theirs.log_evidence, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ours.cov, theirs.cov, rtol=1e-12, atol=1e-12)
        total += len(ours)
    assert total > 0


def test_no_direction_and_lines_of_sight_do_too() -> None:
    compact, whole = (StationMixtures(part) for part in parts(7))
    weights = LineOfSightWeights(-0.5, -1.5)
    for ours, theirs in (
        (compact.towards(NO_DIRECTION), whole.towards(NO_DIRECTION)),
        (compact.towards(towards(0.3, 1.2, 0.1), weights), whole.towards(towards(0.3, 1.2, 0.1), weights)),
    ):
        assert len(ours) == len(theirs) > 0
        np.testing.assert_allclose(ours.log_evidence, theirs.log_evidence, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", ["aoa", "aoa+pt", "aoa+toa", "tdoa"])
def test_fixes_move_by_a_small_share_of_their_deviation(tmp_path: Path, kind: str) -> None:
    """Of what they are with single precision, whose closed forms other tests check."""
    whole = table_of(tmp_path / "whole.h5", *TUBES)
    compact = compact_copy(whole, tmp_path / "compact.h5")
    assert (whole.format_version, compact.format_version) == (4, 5)
    report = report_of(differences("a") if kind == "tdoa" else measured(kind))
    before, after = (Locator(table, EXACT).locate(report) for table in (whole, compact))
    assert before.position is not None
    assert after.position is not None
    deviation = np.sqrt(np.trace(before.candidates[0].covariance))
    moved = np.linalg.norm(before.position - after.position)
    assert 0.0 < moved < 2e-3 * deviation
    assert after.log_evidence == pytest.approx(before.log_evidence, abs=5e-3)
    np.testing.assert_allclose(
        after.candidates[0].covariance, before.candidates[0].covariance, rtol=0.0, atol=3e-3 * deviation**2
    )
