"""Position error bound: the smallest error of unbiased estimators that know every path.

A reflected path is a straight line to the *unfolded* point: the point mirrored back, from the last plane to
the first, into the station's space. There the gradients of azimuth, zenith and length are those of a straight line;
mirrored forward again, they are gradients with respect to the point itself. The Fisher information sums their outer
products over the stations,

    J = sum_i  g_az g_az^T / azimuth_stdev^2 + g_ze g_ze^T / zenith_stdev^2 + (time terms),

and the bound is the square root of the trace of its inverse.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_evaluation.truth.forward import Paths

__all__ = ["information_bound", "path_gradients", "position_error_bound"]

_SINGULAR = 1e-12  # smallest ratio of the eigenvalues of an information matrix that is inverted
_SAME_PLACE = 1e-6  # m; the paths have to belong to the stations and the point


def path_gradients(paths: Paths, index: int) -> NDArray[np.float64]:
    """Gradients of one path's azimuth, zenith and length with respect to the point.

    Parameters
    ----------
    paths : Paths
        Paths between a station and the point.
    index : int
        Index of the path.

    Returns
    -------
    ndarray of shape (3, 3), rad/m, rad/m and 1
        Rows: azimuth, zenith, length; columns: x, y, z. The angles of a path that leaves the station straight
        up or down have no gradient; their rows are zero.
    """
    bounces = int(paths.num_reflections[index])
    vertices = paths.vertices[index, : bounces + 2]
    segments = np.diff(vertices, axis=0)
    lengths = np.linalg.norm(segments, axis=1, keepdims=True)
    directions = segments / lengths
    # Product of the reflections from the station's end; it maps a displacement of the point to that of the unfolded
    # point.
    mirrors = np.eye(3)
    for incoming, outgoing in itertools.pairwise(directions):
        normal = (outgoing - incoming) / np.linalg.norm(outgoing - incoming)
        mirrors = mirrors @ (np.eye(3) - 2.0 * np.outer(normal, normal))
    # Without what slabs add: it hardly changes with the point, and the angles turn with the distance.
    length = float(lengths.sum())
    x, y, z = length * directions[0]
    square = x * x + y * y
    horizontal = np.sqrt(square)
    gradients = np.zeros((3, 3))
    gradients[2] = directions[0]
    if horizontal > 1e-9 * length:
        gradients[0] = np.array([-y, x, 0.0]) / square
        gradients[1] = np.array([x * z / horizontal, y * z / horizontal, -horizontal]) / length**2
    unfolded: NDArray[np.float64] = gradients @ mirrors
    return unfolded


def position_error_bound(
    station_positions: ArrayLike,
    paths: Sequence[Paths],
    selected: Sequence[int],
    point: ArrayLike,
    noise: Noise,
    *,
    timing: Timing,
) -> float:
    """Bound on the root mean square position error, given which path each station reports.

    Parameters
    ----------
    station_positions : ndarray of shape (n_stations, 3), m
        Positions of the stations.
    paths : sequence of Paths
        Paths of each station to the point.
    selected : sequence of int
        Index of the path that each station reports, -1 if it has none.
    point : ndarray of shape (3,), m
        Position of the transmitter.
    noise : Noise
        Standard deviations; that of the azimuth is of the angle itself, at any zenith.
    timing : {"none", "pt", "toa", "tdoa"}
        Times that are measured in addition to the angles. ``"toa"`` has an unknown common clock offset, which is
        projected out (Schur complement). The differences of ``"tdoa"`` have the same information, because all contain
        the noise of the reference.

    Returns
    -------
    float
        Square root of the trace of the inverse information, m; infinite if the measurements leave a direction
        undetermined.

    Raises
    ------
    ValueError
        If the arguments are inconsistent, or times are measured and ``noise.range_stdev`` is None.
    """
    stations = np.asarray(station_positions, dtype=np.float64).reshape(-1, 3)
    target = np.asarray(point, dtype=np.float64)
    if not len(stations) == len(paths) == len(selected):
        raise ValueError(
            f"there are {len(stations)} stations, {len(paths)} sets of paths and {len(selected)} selections; "
            "give one of each per station"
        )
    if timing not in ("none", "pt", "toa", "tdoa"):
        raise ValueError(f"the timing is {timing!r}; use 'none', 'pt', 'toa' or 'tdoa'")
    lengths: list[NDArray[np.float64]] = []
    information = np.zeros((3, 3))
    for i, (station, candidates, index) in enumerate(zip(stations, paths, selected, strict=True)):
        if index < 0:
            continue
        ends = candidates.vertices[index, [0, -1]]
        if not np.allclose(ends, [station, target], rtol=0.0, atol=_SAME_PLACE):
            raise ValueError(f"paths[{i}] lead from {ends[0]} to {ends[1]}, not from {station} to {target}")
        azimuth, zenith, length = path_gradients(candidates, index)
        information += np.outer(azimuth, azimuth) / noise.azimuth_stdev**2
        information += np.outer(zenith, zenith) / noise.zenith_stdev**2
        lengths.append(length)
    return information_bound(information, lengths, noise, timing=timing)


def information_bound(
    information: NDArray[np.float64], lengths: Sequence[NDArray[np.float64]], noise: Noise, *, timing: Timing
) -> float:
    """Bound from the information of angles and the gradients of measured path lengths.

    Parameters
    ----------
    information : ndarray of shape (3, 3), 1/m2
        Fisher information of the angles.
    lengths : sequence of ndarray of shape (3,)
        Gradients of the path lengths with respect to the point.
    noise, timing
        As of :func:`position_error_bound`.

    Returns
    -------
    float
        As in :func:`position_error_bound`, m.

    Raises
    ------
    ValueError
        If times are measured and ``noise.range_stdev`` is None.
    """
    if timing != "none" and len(lengths):
        if noise.range_stdev is None:
            raise ValueError(f"the timing is {timing!r}, but noise.range_stdev is None; give it in metres")
        rows = np.array(lengths)
        if timing != "pt":
            rows = rows - rows.mean(axis=0)
        information = information + rows.T @ rows / noise.range_stdev**2
    eigenvalues = np.linalg.eigvalsh(information)
    if not eigenvalues[0] > _SINGULAR * eigenvalues[-1]:
        return float("inf")
    return float(np.sqrt(np.sum(1.0 / eigenvalues)))
