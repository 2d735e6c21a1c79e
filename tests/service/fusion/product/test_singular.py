"""Matrices that rounding makes singular: what has them is left out and counted, and nobody else's weight is lost."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.observations import sort_report
from rayfix_service.fusion.posterior.fixes import Product, make_fix
from rayfix_service.fusion.posterior.summary import GaussianPosterior, sum_up
from rayfix_service.fusion.product import beam_kernels, information_form
from rayfix_service.fusion.product.beam import Hypotheses, multiply
from rayfix_service.fusion.product.factor_kernels import ALL_GOOD, ALL_OUTLIER, PART, READING, make_alternatives
from rayfix_service.fusion.product.factors import Factor
from rayfix_service.fusion.product.merging import merge_hypotheses
from rayfix_service.fusion.product.outliers import OutlierIndex
from rayfix_service.fusion.product.prior import Prior
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import NEVER
from rayfix_service.locator import Locator
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.cholesky import cholesky
from tests.support.messages.hand_reports import angle_of, report_of
from tests.support.tables.hand_tables import MakeTable, line_of_sight

Array = NDArray[np.float64]

HALL = FreeSpace(origin=np.zeros(3), voxel_size=0.5, free=np.ones((20, 20, 20), bool))
BROKEN = {"indefinite": np.diag([0.04, -0.04, 0.04]), "singular": np.zeros((3, 3)), "nan": np.full((3, 3), np.nan)}


def test_every_position_of_a_product_has_a_covariance_with_a_factor() -> None:
    """Of a position and a clock, whose inverse may have a positive determinant and a position's block that has not."""
    rng = np.random.default_rng(0)
    count, dimension = 1000, 4
    turn = np.linalg.qr(rng.standard_normal((count, dimension, dimension)))[0]
    scale = np.exp(rng.uniform(-25.0, 25.0, (count, dimension)))
    information = turn @ (scale[:, :, None] * turn.transpose(0, 2, 1))
    information = 0.5 * (information + information.transpose(0, 2, 1))
    columns = information_form.pack(information, rng.normal(size=(count, dimension)), np.zeros(count))
    number = np.arange(count, dtype=np.int16)[:, None]
    score, mean, cov, chosen, dropped = beam_kernels.place_hypotheses(columns, np.zeros(count), number)
    assert all(cholesky(one, np.empty((3, 3))) for one in cov)
    assert len(score) == len(mean) == len(cov) == len(chosen) == count - dropped
    # Nearly all are regular in spite of condition numbers up to 1e21.
    assert 0 < dropped < 0.2 * count


@pytest.mark.parametrize("dimension", [3, 4, 5])
def test_a_union_that_is_singular_is_not_made(dimension: int) -> None:
    """Unions of Gaussians 1e10 m apart have condition numbers of 1e20; a merge at any price lost all but one weight."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        information = np.tile(np.eye(dimension), (8, 1, 1))
        columns = information_form.pack(information, 1e10 * rng.standard_normal((8, dimension)), np.zeros(8))
        score = rng.normal(size=8)
        before = np.logaddexp.reduce(score)
        left = merge_hypotheses(columns, score, np.zeros(8, np.int64), np.inf)
        assert np.logaddexp.reduce(score[left]) == pytest.approx(before, abs=1e-9)


@pytest.mark.parametrize("readings", [[], [(0, 3.0, 0.25)]])
def test_a_singular_alternative_is_left_out_and_counted(readings: list[tuple[int, float, float]]) -> None:
    mean = np.array([[1.0, 2.0, 1.0, 5.0], [2.0, 2.0, 1.0, 6.0], [8.0, 7.0, 2.0, 9.0]])
    cov = np.tile(0.04 * np.eye(4), (3, 1, 1))
    cov[1, 0, 0] = -1e-9  # m2

    def made(which: list[int]) -> tuple[Array, NDArray[np.int8], int, int]:
        part = np.array([(ALL_GOOD, 0, len(which), 0.0, 0.0, np.inf, 0.0, 0, len(readings))], PART)
        weights = np.log(np.array([0.3, 0.5, 0.2]))[which]
        times = np.array(readings, READING)
        settings = (1, (5.0, 0.0, 0.0), (-9.0, -20.0, 0.0, 100), NEVER.cell)
        found: tuple[Array, NDArray[np.int8], int, int] = make_alternatives(
            (weights, mean[which], cov[which]), part, times, *settings
        )
        return found

    columns, outlier, omitted, dropped = made([0, 1, 2])
    expected, expected_outlier, _, none = made([0, 2])
    np.testing.assert_array_equal(columns, expected)
    np.testing.assert_array_equal(outlier, expected_outlier)
    assert outlier.tolist() == [ALL_GOOD, ALL_GOOD, ALL_OUTLIER]
    assert (omitted, dropped, none) == (0, 1, 0)


def test_what_factors_and_products_leave_out_is_counted() -> None:
    information, outlier = np.zeros((2, 3, 3)), np.array([ALL_GOOD, ALL_OUTLIER], np.int8)
    information[0] = np.diag([25.0, -25.0, 25.0])
    broken = Factor(columns=information_form.pack(information, np.zeros((2, 3)), np.zeros(2)), outlier=outlier)
    information[0] = np.diag([25.0, 25.0, 25.0])
    columns = information_form.pack(
        information, np.array([[100.0, 100.0, 50.0], [0.0, 0.0, 0.0]]), np.array([-130.0, -5.0])
    )
    whole = Factor(columns=columns, outlier=outlier, dropped=3)
    prior = Prior(log_volume=float(np.log(1000.0)))
    found = multiply([broken, whole], max_path_length=50.0, prior=prior, width=10, max_divergence=0.0)
    assert found.dropped == 3 + 1
    assert len(found) == 1
    np.testing.assert_allclose(found.mean, [[4.0, 4.0, 2.0]], rtol=1e-12)


def broken_hypotheses(kind: str) -> Hypotheses:
    """Two hypotheses without a covariance."""
    return Hypotheses(
        log_weight=np.log([0.6, 0.4]),
        mean=np.array([[3.0, 3.0, 3.0], [7.0, 7.0, 7.0]]),
        cov=np.tile(BROKEN[kind], (2, 1, 1)),
        outlier=np.zeros((2, 1), np.int8),
        log_all_outlier=-4.0,
    )


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_where_all_are_singular_everything_is_an_outlier(kind: str) -> None:
    index = OutlierIndex([0], np.array([[0, 0, ALL_OUTLIER]]))
    summary = sum_up(broken_hypotheses(kind), index, HALL, 1e-4)
    assert (summary.log_evidence, summary.lost, summary.half_bad) == (-4.0, 1.0, 1.0)
    assert len(summary.probability) == len(summary.position) == len(summary.moment) == 0
    assert summary.outlier.tolist() == [1.0]


@pytest.mark.parametrize("kind", sorted(BROKEN))
def test_a_fix_where_all_are_singular_is_inconsistent(make_table: MakeTable, kind: str) -> None:
    tube = line_of_sight("a")
    table, report = make_table(tube), report_of([angle_of(tube)])
    observations = list(sort_report(report, table.site).observations)
    posterior = GaussianPosterior(gaussians=broken_hypotheses(kind))
    product = Product(observations, {}, Prior(log_volume=float(np.log(64.0**3))), posterior)
    fix = make_fix(report, product, table, FusionSettings())
    assert (fix.status, fix.candidates, fix.regions, fix.log_evidence) == ("inconsistent", (), None, -4.0)
    assert [outcome.outlier_probability for outcome in fix.outcomes] == [1.0]


def test_a_fix_says_that_gaussians_were_left_out(make_table: MakeTable, monkeypatch: pytest.MonkeyPatch) -> None:
    tube = line_of_sight("a")
    locator = Locator(make_table(tube))
    assert locator.locate(report_of([angle_of(tube)])).simplified == ()
    counted = partial(_with_count, multiply, 2)
    monkeypatch.setattr("rayfix_service.fusion.fusion.multiply", counted)
    (said,) = locator.locate(report_of([angle_of(tube)])).simplified
    assert said.startswith("2 Gaussians were left out")


def _with_count(
    make: Callable[..., Hypotheses], dropped: int, *factors: Sequence[Factor], **settings: Any
) -> Hypotheses:
    return replace(make(*factors, **settings), dropped=dropped)
