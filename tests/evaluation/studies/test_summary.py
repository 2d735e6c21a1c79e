"""Runs summed up."""

import numpy as np
import pytest

from rayfix_evaluation.studies.statements import check_statements
from rayfix_evaluation.studies.summary import Run, percentile, probability_lower, summarise


def run_of(error: np.ndarray, bound: float = 0.1, covered: np.ndarray | None = None) -> Run:
    count = len(error)
    return Run(
        error=np.asarray(error, np.float64),
        bound=np.full(count, bound),
        hidden=np.zeros(count, np.int64),
        heard=np.ones(count, np.int64),
        covered=covered,
    )


def test_percentiles_count_missing_positions_as_far_away() -> None:
    run = run_of(np.array([0.1, 0.2, 0.3, np.inf, np.inf]))
    assert percentile(run.error, 50) == 0.3
    assert percentile(run.error, 90) == np.inf
    found = summarise(run, 1)
    assert found["p50"][0] == 0.3
    assert found["p90"][0] is None
    assert found["unanswered"] == 0.4


def test_failures_are_above_five_bounds_and_a_metre() -> None:
    """Errors of 0.6 m (six bounds, no metre), 1.2 m (both), 1.2 m with a bound of 1 m (a metre, no five bounds)."""
    run = run_of(np.array([0.6, 1.2, 1.2]))
    run.bound[2] = 1.0
    assert run.gross.tolist() == [False, True, False]


def test_intervals_hold_the_median_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        _, low, high = summarise(run_of(rng.exponential(1.0, 60)), 3)["p50"]
        hits += low <= np.log(2.0) <= high
    # 95 % of 200 and three standard deviations of that, wider below for the bootstrap's own bias.
    assert 178 <= hits <= 199


def test_the_same_drops_are_drawn_for_both_of_a_pair() -> None:
    """One that is a millimetre better on each drop is better in every resample, though drops differ by metres."""
    error = np.random.default_rng(2).exponential(1.0, 80)
    assert probability_lower(run_of(error - 1e-3), run_of(error), 90, 1) == 1.0


def test_a_document_gives_the_run_back() -> None:
    covered = np.array([[True, True, False, True], [False] * 4])
    run = run_of(np.array([0.12344, np.inf]), covered=covered)
    again = Run.of_document(run.document())
    assert again.error.tolist() == [0.1234, np.inf]
    assert again.covered is not None
    assert again.covered.tolist() == covered.tolist()
    parts = Run.joined([again, again])
    assert parts.error.tolist() == [0.1234, np.inf] * 2


@pytest.mark.parametrize("strong", [True, False])
def test_statements_follow_the_numbers(strong: bool) -> None:
    """Errors in proportion to a factor of each case, so that every statement is known beforehand."""
    base = np.linspace(0.01, 1.0, 50)
    factors = {
        ("cdf-aoa", "1 deg"): 5.0 if strong else 1.5,
        ("cdf-aoa", "1 deg + PT 0.5 m"): 1.0,
        ("cdf-aoa", "0.25 deg + PT 0.5 m"): 0.3 if strong else 0.9,
        ("cdf-pt", "PT 0.2 m"): 0.9 if strong else 0.2,
        ("cdf-pt", "PT 1 m"): 1.1,
        ("cdf-rpt", "RPT 0.5 m"): 2.0 if strong else 0.8,
    }
    runs = {
        (study, point, method): run_of(factor * scale * base)
        for (study, point), factor in factors.items()
        for method, scale in (("paper", 1.0), ("rayfix", 0.5 if strong else 1.2))
    }
    assert [s.holds for s in check_statements(runs, 1)] == [strong] * 7
    assert all(bool(s.reason) != strong for s in check_statements(runs, 1))
