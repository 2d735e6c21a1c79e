"""The n-th smallest value, against sorting."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_service.fusion.posterior.order_statistics import nth_smallest


@settings(deadline=None)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=40), st.data())
def test_the_value_at_a_rank_is_that_of_the_sorted_values(values: list[float], data: st.DataObject) -> None:
    rank = data.draw(st.integers(0, len(values) - 1))
    assert nth_smallest(np.array(values), rank) == sorted(values)[rank]


@settings(deadline=None)
@given(st.lists(st.integers(0, 3).map(float), min_size=1, max_size=40), st.data())
def test_values_may_be_alike(values: list[float], data: st.DataObject) -> None:
    rank = data.draw(st.integers(0, len(values) - 1))
    assert nth_smallest(np.array(values), rank) == sorted(values)[rank]


@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e300])
def test_all_ranks_of_many_values(scale: float) -> None:
    values = scale * np.random.default_rng(0).lognormal(sigma=3.0, size=1000)
    assert [nth_smallest(values, rank) for rank in range(1000)] == np.sort(values).tolist()


def test_neighbours_among_the_floats_are_told_apart() -> None:
    values = np.array([1.0, np.nextafter(1.0, 2.0), 1.0, np.nextafter(1.0, 0.0)])
    assert [nth_smallest(values, rank) for rank in range(4)] == np.sort(values).tolist()
