"""Probabilities of detection: fractions at the corners of voxels against dictionaries, and what is made of them."""

import math
from itertools import pairwise, product

import numpy as np
import pytest

from rayfix_service.fusion.quadrature.detection import detected_at, detected_paths, log_odds, shares_at_corners
from tests.support.tables.one_voxel import LENGTHS, one_voxel


def test_shares_at_corners_against_dictionaries() -> None:
    """Each corner has the mean over the voxels round it in which anything is heard."""
    rng = np.random.default_rng(5)
    shape, counts = (4, 3, 2), rng.integers(0, 4, 24)
    sequence = np.concatenate([rng.permutation(5)[:n] for n in counts]).astype(np.int32)
    lit = rng.uniform(0.1, 1.0, len(sequence)).astype(np.float32)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    new_offsets, source, corners = shares_at_corners(offsets, sequence, lit, np.array(shape), 5)
    lists = [dict(zip(sequence[a:b].tolist(), lit[a:b].tolist(), strict=True)) for a, b in pairwise(offsets)]
    for voxel in range(24):
        at = np.array(np.unravel_index(voxel, shape))
        expected: dict[int, list[float]] = {}
        for number, corner in enumerate(product((-1, 0), (-1, 0), (-1, 0))):
            round_it = [
                lists[np.ravel_multi_index(tuple(place), shape)]
                for place in (at + np.array(corner) + step for step in product((0, 1), (0, 1), (0, 1)))
                if np.all(place >= 0) and np.all(place < shape)
            ]
            heard = [each for each in round_it if each]
            for each in heard:
                for s, share in each.items():
                    expected.setdefault(s, [0.0] * 8)[number] += share / len(heard)
        own = slice(new_offsets[voxel], new_offsets[voxel + 1])
        found = dict(zip(sequence[source[own]].tolist(), corners[own].tolist(), strict=True))
        assert found.keys() == expected.keys()
        for s, values in expected.items():
            assert found[s] == pytest.approx(values, rel=1e-5)
        for path in source[own]:  # a voxel's own path stands for itself, which has its own gain
            if sequence[path] in lists[voxel]:
                assert offsets[voxel] <= path < offsets[voxel + 1]


def test_detection_is_continuous_across_a_face() -> None:
    """Two voxels side by side, lit fully and not at all: no jump where they meet, and a steep fall between them."""
    offsets, sequence, lit = np.array([0, 2, 3]), np.array([0, 1, 1], np.int32), np.array([1.0, 1.0, 1.0], np.float32)
    new_offsets, source, corners = shares_at_corners(offsets, sequence, lit, np.array([2, 1, 1]), 2)
    whole = np.rint(255 * corners).astype(np.uint8)
    left, right = (
        next(n for n in range(new_offsets[v], new_offsets[v + 1]) if sequence[source[n]] == 0) for v in (0, 1)
    )
    for y in (0.1, 0.7):
        assert detected_at(0.9, whole[left], 1.0, y, 0.3) == pytest.approx(detected_at(0.9, whole[right], 0.0, y, 0.3))
    assert detected_at(0.9, whole[left], 0.0, 0.5, 0.5) > 0.89
    assert detected_at(0.9, whole[right], 1.0, 0.5, 0.5) < 0.05


def test_the_point_of_a_voxel_interpolates_its_corners() -> None:
    rng = np.random.default_rng(7)
    corners = rng.integers(0, 256, 8).astype(np.uint8)
    for place in rng.random((20, 3)):
        weight = [
            np.prod([p if c else 1.0 - p for p, c in zip(place, at, strict=True)]) for at in product((0, 1), repeat=3)
        ]
        share = float(np.dot(weight, corners)) / 255.0
        expected = 0.8 / (1.0 + math.exp(-float(log_odds(np.array(share)))))
        assert detected_at(0.8, corners, *place) == pytest.approx(expected, rel=1e-12)


def test_a_path_at_the_limit_is_as_likely_as_not_to_be_reported() -> None:
    paths = one_voxel([1.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    gain = 1.0 / LENGTHS**2
    below = 10.0 * math.log10(gain.sum() / gain[0])
    found, detail = detected_paths(paths, below)
    weight = np.empty(3)
    weight[found.sequence] = found.weight
    assert weight[0] == pytest.approx(0.475, abs=0.015)  # half of the 95 % that no path exceeds
    assert 0.9 < weight[1] < 0.96
    assert found.sequence[0] == 1  # the strongest comes first
    np.testing.assert_array_equal(detail.corners, 255)
