"""Figures of calibration on fixes whose errors are known."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binomtest

from rayfix_evaluation.drops.accuracy import Drop, LocatedDrop
from rayfix_evaluation.drops.calibration import calibrate, ellipsoid_holds, wilson_interval
from rayfix_service.fusion.posterior.credible import CredibleRegions
from rayfix_service.fusion.posterior.fix import Candidate, Fix
from rayfix_service.fusion.posterior.points import ListedPoints
from rayfix_tables.gaussians.normal_points import normal_points

COV = np.array([[0.5, 0.2, 0.0], [0.2, 0.3, 0.1], [0.0, 0.1, 0.4]])


def fix_of(*positions: NDArray[np.float64], cov: NDArray[np.float64] = COV) -> Fix:
    candidates = tuple(
        Candidate(probability=1.0 / (n + 2), position=position, covariance=cov) for n, position in enumerate(positions)
    )
    points = positions[0] + normal_points(1024) @ np.linalg.cholesky(cov).T
    regions = CredibleRegions(position=positions[0], covariance=cov, points=ListedPoints(position=points), share=1.0)
    return Fix(status="ok", candidates=candidates, outcomes=(), log_evidence=0.0, table_id="", regions=regions)


def located(truth: NDArray[np.float64], fix: Fix, bound: float = 0.1) -> LocatedDrop:
    return LocatedDrop(drop=Drop(position=truth, paths={}), fix=fix, bound=bound, seconds=0.0)


@pytest.mark.parametrize(("hits", "total"), [(0, 10), (3, 10), (95, 100), (100, 100)])
@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_interval_of_a_proportion(hits: int, total: int, confidence: float) -> None:
    expected = binomtest(hits, total).proportion_ci(confidence, method="wilson")
    np.testing.assert_allclose(wilson_interval(hits, total, confidence), expected, rtol=0, atol=1e-12)


def test_nothing_is_known_of_no_drops() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
    found = calibrate([], [0.5])
    assert (found.count, found.gross, found.rival_right) == (0, 0, 0)
    assert dict(found.covered) == {0.5: 0}


def test_ellipsoids_of_gaussian_errors_cover_what_they_say() -> None:
    rng = np.random.default_rng(1)
    count = 4000
    errors = rng.multivariate_normal(np.zeros(3), COV, size=count)
    for probability in (0.5, 0.68, 0.9, 0.99):
        fix = fix_of(np.ones(3))
        inside = sum(ellipsoid_holds(fix, probability, np.ones(3) + error) for error in errors)
        low, high = wilson_interval(inside, count, 0.9999)
        # The ellipsoid itself is as exact as a thousand points are.
        assert low - 0.003 < probability < high + 0.003


def test_without_a_position_nothing_is_held() -> None:
    nothing = Fix(status="insufficient", candidates=(), outcomes=(), log_evidence=0.0, table_id="")
    assert not ellipsoid_holds(nothing, 0.99, np.zeros(3))


def test_gross_failures_and_right_rivals_are_told_apart() -> None:
    here, far, wrong = np.zeros(3), np.array([9.0, 0.0, 0.0]), np.array([0.0, 9.0, 0.0])
    near = np.array([0.3, 0.0, 0.0])
    tight = 0.01 * COV
    items = [
        located(here, fix_of(near)),  # three bounds: fair
        located(here, fix_of(far, here)),  # gross, the rival is right
        located(here, fix_of(far, wrong)),  # gross, the rival is wrong too
        located(here, fix_of(near, cov=tight), bound=0.01),  # 30 bounds, but less than a metre: neither
        located(here, fix_of(far), bound=20.0),  # the measurements do not determine it: not compared
    ]
    found = calibrate(items, [0.5, 0.99])
    assert (found.count, found.gross, found.rival_right) == (5, 2, 1)
    assert found.rms_ratio == pytest.approx(3.0, rel=1e-12)
    assert dict(found.covered) == {0.5: 1, 0.99: 1}


def test_fixes_without_a_position_are_left_out() -> None:
    nothing = Fix(status="inconsistent", candidates=(), outcomes=(), log_evidence=0.0, table_id="")
    item = located(np.zeros(3), nothing)
    assert item.error == np.inf
    assert calibrate([item], [0.5]).count == 0
