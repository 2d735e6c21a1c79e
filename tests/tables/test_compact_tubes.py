"""What rounding to half precision costs components and path maps, and what it must not break."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_tables.compact.expanding import expand, expanded_tubes, half, no_tubes
from rayfix_tables.compact.tubes import COMPACT_FIELDS, CompactTubes, compacted
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.mixture import FIELD_SHAPES, Tubes, pack, unpack
from rayfix_tables.paths import PathMap
from tests.support.tables.random_tables import random_paths, random_tubes

HALF = 2.0**-11
"""Largest relative error of half precision, of numbers that are not below 2^-14."""

SINGLE = 2.0**-24

SMALLEST = 2.0**-25
"""Largest error of numbers below that."""

SEEDS = st.integers(0, 2**32 - 1)
WINDOWS = st.floats(1e-3, 0.3)
LONGEST = st.floats(0.1, 1e4)


def roots(packed: Any, units: Any = 1.0) -> np.ndarray:
    """Lower triangular roots of packed covariances, their rows in these units, by LAPACK."""
    scale = np.broadcast_to(units, 3)
    return np.linalg.cholesky(unpack(np.asarray(packed, np.float64)) / (scale[:, None] * scale))


def assert_same_components(actual: CompactTubes, expected: CompactTubes) -> None:
    assert actual.window == expected.window
    for name, (dtype, shape) in COMPACT_FIELDS.items():
        ours, theirs = getattr(actual, name), getattr(expected, name)
        assert ours.dtype == dtype
        assert ours.shape == (len(expected), *shape)
        assert ours.tobytes() == theirs.tobytes(), name


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, window=WINDOWS, longest=LONGEST)
def test_what_rounding_costs(seed: int, window: float, longest: float) -> None:
    tubes = random_tubes(np.random.default_rng(seed), 50, window, longest=longest)
    found = compacted(tubes, window).expanded
    units = np.array([1.0, window, window])
    np.testing.assert_allclose(found.log_weight, tubes.log_weight, rtol=0.0, atol=0.5 / 1024.0 + 1e-12)
    np.testing.assert_allclose(found.u_mean[:, 0], tubes.u_mean[:, 0], rtol=SINGLE)
    np.testing.assert_allclose(found.u_mean[:, 1:], tubes.u_mean[:, 1:], rtol=HALF, atol=SMALLEST * window)
    for ours, theirs in (
        (roots(found.u_cov, units), roots(tubes.u_cov, units)),
        (roots(found.x_cov), roots(tubes.x_cov)),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=HALF * (1.0 + 1e-3), atol=SMALLEST)
    across = np.stack([np.ones(len(tubes)), tubes.u_mean[:, 0], tubes.u_mean[:, 0]], axis=-1)[:, None]
    np.testing.assert_allclose(
        found.jacobian / across, tubes.jacobian / across, rtol=HALF * (1.0 + 1e-3), atol=SMALLEST
    )
    # At the same length and angles, the tube is where it was.
    moved = np.einsum("nij,nj->ni", tubes.jacobian, tubes.u_mean - found.u_mean)
    farthest = np.abs(tubes.x_mean).max() + np.abs(moved).max()
    np.testing.assert_allclose(found.x_mean + moved, tubes.x_mean, rtol=0.0, atol=2.0 * SINGLE * farthest)


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, window=WINDOWS, longest=LONGEST)
def test_what_is_rounded_once_is_not_rounded_again(seed: int, window: float, longest: float) -> None:
    found = compacted(random_tubes(np.random.default_rng(seed), 50, window, longest=longest), window)
    assert_same_components(compacted(found.expanded, window), found)


def test_a_component_has_65_bytes_and_one_for_walls() -> None:
    found = compacted(random_tubes(np.random.default_rng(0), 10, 0.02), 0.02)
    assert found.num_bytes == 10 * 66
    assert sum(np.dtype(dtype).itemsize * int(np.prod(shape)) for dtype, shape in COMPACT_FIELDS.values()) == 66
    assert found.expanded.num_bytes == 10 * (28 * 8 + 2)


def test_thin_ones_remain_definite() -> None:
    """Up to ten thousand times as long as wide, in any direction."""
    rng = np.random.default_rng(1)
    tubes = random_tubes(rng, 500, 0.02)
    axes = np.linalg.qr(rng.normal(size=(500, 3, 3)))[0] * 10.0 ** rng.uniform(-3.0, 1.0, (500, 1, 3))
    cov = axes @ axes.transpose(0, 2, 1)
    eigenvalues = np.linalg.eigvalsh(cov)
    assert np.count_nonzero(eigenvalues[:, 2] > 1e7 * eigenvalues[:, 0]) > 10
    found = compacted(replace(tubes, x_cov=pack(cov)), 0.02)
    assert np.all(np.linalg.eigvalsh(unpack(found.x_cov))[:, 0] > 0.0)


def one(**changes: Any) -> Any:
    """One tube along the axes, with changes."""
    tubes = random_tubes(np.random.default_rng(2), 1, 0.02)
    plain = {
        "log_weight": np.array([-1.0]),
        "u_mean": np.array([[10.0, 0.01, -0.02]]),
        "u_cov": np.array([[0.25, 0.0, 0.0, 1e-4, 0.0, 4e-4]]),
        "x_mean": np.array([[1.0, 2.0, 3.0]]),
        "jacobian": np.diag([1.0, 10.0, 10.0])[None],
        "x_cov": np.array([[0.01, 0.0, 0.0, 0.01, 0.0, 0.01]]),
    }
    return replace(tubes, **{name: np.array(value) for name, value in (plain | changes).items()})


def test_no_weight_is_lost() -> None:
    found = compacted(one(log_weight=[-700.0]), 0.02)
    assert found.log_weight[0] == pytest.approx(-64.0, abs=1e-3)
    assert compacted(one(log_weight=[1e-9]), 0.02).log_weight[0] == 0.0


def test_what_is_too_narrow_is_widened() -> None:
    found = compacted(one(u_cov=[[1e-18, 0.0, 0.0, 1e-22, 0.0, 1e-22]], x_cov=[[1e-20, 0.0, 0.0, 1.0, 0.0, 1.0]]), 0.02)
    np.testing.assert_allclose(np.sqrt(found.u_cov[0, [0, 3, 5]]), 2.0**-14 * np.array([1.0, 0.02, 0.02]), rtol=1e-12)
    np.testing.assert_allclose(np.sqrt(found.x_cov[0, [0, 3, 5]]), [2.0**-14, 1.0, 1.0], rtol=1e-12)


def test_a_slope_beyond_half_precision_becomes_a_spread() -> None:
    steep = one(jacobian=[[[-1e5, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0]]])
    found = compacted(steep, 0.02).expanded
    assert found.jacobian[0, 0, 0] == -65504.0
    lost = (1e5 - 65504.0) ** 2 * 0.25
    assert found.x_cov[0, 0] == pytest.approx(lost, rel=1e-3)
    np.testing.assert_allclose(found.x_cov[0, 1:], steep.x_cov[0, 1:], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"log_weight": [0.01]}, "weight of a component is above 1"),
        ({"log_weight": [np.nan]}, "log_weight of a component is not finite"),
        ({"u_mean": [[np.inf, 0.0, 0.0]]}, "u_mean of a component is not finite"),
        ({"u_mean": [[0.0, 0.0, 0.0]]}, "path length of a component is not positive"),
        ({"x_mean": [[0.0, np.nan, 0.0]]}, "x_mean of a component is not finite"),
        ({"jacobian": np.full((1, 3, 3), np.inf)}, "jacobian of a component is not finite"),
        ({"u_cov": [[1.0, 1.1, 0.0, 1.0, 0.0, 1.0]]}, "covariance of a component is not positive definite"),
        ({"u_cov": [[1.0, 0.0, 0.0, 0.0, 0.0, 1.0]]}, "covariance of a component is not positive definite"),
        ({"x_cov": [[1.0, 0.0, 0.0, 1.0, 0.0, np.nan]]}, "covariance of a component is not positive definite"),
        ({"x_cov": [[1e10, 0.0, 0.0, 1.0, 0.0, 1.0]]}, "a component is wider than 65504 m or windows"),
    ],
)
def test_what_has_no_place_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        compacted(one(**changes), 0.02)


def test_the_kernel_reads_every_number_of_half_precision() -> None:
    bits = np.arange(2**16).astype(np.uint16)
    numbers = bits.view(np.float16).astype(np.float64)
    finite = np.isfinite(numbers)
    assert np.count_nonzero(finite) == 2**16 - 2**11
    found = np.array([half(each) for each in bits[finite]])
    assert found.tobytes() == numbers[finite].tobytes()


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, window=WINDOWS)
def test_the_kernel_expands_like_its_twin(seed: int, window: float) -> None:
    stored = compacted(random_tubes(np.random.default_rng(seed), 30, window), window)
    begins, ends = np.array([20, 3, 9]), np.array([30, 9, 9])
    rows = np.concatenate([np.arange(begin, end) for begin, end in zip(begins, ends, strict=True)])
    out = no_tubes(len(rows))
    expand(tuple(stored.arrays), window, begins, ends, out)
    expected = stored[rows]
    for name, array in zip(Tubes._fields, out, strict=True):
        np.testing.assert_allclose(array, getattr(expected, name), rtol=4e-16, atol=0.0)
    some = expanded_tubes(stored, 4, 8)
    assert some.x_cov.tobytes() == expanded_tubes(stored[4:8], 0, 4).x_cov.tobytes()


def test_components_are_taken_and_joined_as_they_are_stored() -> None:
    stored = compacted(random_tubes(np.random.default_rng(3), 20, 0.02), 0.02)
    assert_same_components(
        CompactTubes.concatenate([stored.take(slice(0, 7)), stored.take(slice(7, 20))], 0.02), stored
    )
    assert_same_components(CompactTubes.from_arrays(stored.to_arrays()), stored)
    none = CompactTubes.concatenate([], 0.02)
    assert (len(none), len(none.expanded)) == (0, 0)
    rows = np.array([5, 0, 5])
    for name in FIELD_SHAPES:
        np.testing.assert_array_equal(getattr(stored[rows], name), getattr(stored.expanded, name)[rows])
    other = compacted(stored.expanded, 0.03)
    with pytest.raises(ValueError, match="several windows"):
        CompactTubes.concatenate([stored, other], 0.02)


# Path maps


def a_map(weight: np.ndarray) -> PathMap:
    space = FreeSpace(origin=np.zeros(3), voxel_size=0.1, free=np.ones((2, 2, 2), bool))
    paths = random_paths(np.random.default_rng(0), space)
    count = len(weight)
    return replace(
        paths,
        offsets=np.array([0, count]),
        sequence=np.arange(count, dtype=np.int32) % len(paths.images),
        weight=weight.astype(np.float32),
    )


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, largest=st.floats(1e-6, 1e6))
def test_what_rounding_costs_a_path(seed: int, largest: float) -> None:
    """Half precision from the largest weight, whatever its unit, to 2e-9 of it; no weight becomes 0."""
    rng = np.random.default_rng(seed)
    weight = largest * 10.0 ** -rng.uniform(0.0, 15.0, 200)
    whole = a_map(np.append(weight, largest))
    compact = whole.compacted
    assert compact.compacted is compact
    ours, theirs = compact.weight_of_1, whole.weight_of_1
    assert ours.dtype == theirs.dtype == np.float32
    heavy = theirs > 2e-9 * largest * 2.0
    np.testing.assert_allclose(ours[heavy], theirs[heavy], rtol=HALF * (1.0 + 1e-6))
    np.testing.assert_allclose(ours[~heavy], theirs[~heavy], rtol=0.0, atol=4e-12 * largest)
    assert np.all(ours > 0.0)
    assert compact.sequence.dtype == np.uint16
    np.testing.assert_array_equal(compact.sequence, whole.sequence)


def test_many_sequences_keep_their_numbers() -> None:
    whole = a_map(np.full(70_000, 0.5))
    many = replace(whole, images=np.zeros((2**16 + 1, 3)), sequence=np.arange(70_000, dtype=np.int32) % (2**16 + 1))
    assert many.compacted.sequence.dtype == np.int32
    np.testing.assert_array_equal(many.compacted.sequence, many.sequence)
    few = replace(many, images=np.zeros((2**16, 3)), sequence=many.sequence % 2**16)
    assert few.compacted.sequence.dtype == np.uint16
    np.testing.assert_array_equal(few.compacted.sequence, few.sequence)
