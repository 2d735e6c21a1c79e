"""Traversal of a voxel map: where a straight segment of a ray crosses from one voxel into the next.

J. Amanatides, A. Woo, "A fast voxel traversal algorithm for ray tracing", Eurographics 1987.

Between two crossings the map is constant and the integrand smooth: the three-point Gauss rule is exact for polynomials
of degree five.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numba
import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

GAUSS = ((0.5 - 0.15**0.5, 5.0 / 18.0), (0.5, 8.0 / 18.0), (0.5 + 0.15**0.5, 5.0 / 18.0))
"""Three-point Gauss rule on [0, 1]: nodes and weights."""

RAY_RANGES = 8
"""Number of ranges of rays, whatever the number of threads: sums are rounded alike on any machine."""


def over_ray_ranges(run: Callable[[int, int], Any], num_rays: int, jobs: int) -> list[Any]:
    """Call a function that releases the interpreter's lock for each range of rays; return a list of its results.

    Parameters
    ----------
    run : callable
        Called with the indices of the first ray and of the one after the last.
    jobs : int
        Threads; -1 for one per core.
    """
    edges = np.linspace(0, num_rays, RAY_RANGES + 1).astype(int).tolist()
    calls = (delayed(run)(first, stop) for first, stop in pairwise(edges))
    return list(Parallel(n_jobs=jobs, prefer="threads")(calls))


class VoxelWalk(NamedTuple):
    """A voxel map and the buffers of :func:`walk`.

    Attributes
    ----------
    origin : ndarray of shape (3,), m
        Low corner of the map.
    voxel_size : float, m
    shape : tuple of 3 ints
        Voxels along each axis.
    lengths, voxels : ndarray
        Buffers of :func:`new_crossings`.
    """

    origin: NDArray[np.float64]
    voxel_size: float
    shape: tuple[int, ...]
    lengths: NDArray[np.float64]
    voxels: NDArray[np.int64]

    @classmethod
    def of(cls, origin: NDArray[np.float64], voxel_size: float, shape: tuple[int, ...]) -> "VoxelWalk":
        """Allocate the buffers for a map of a shape."""
        return cls(origin, voxel_size, shape, *new_crossings(shape))


def new_crossings(shape: tuple[int, ...]) -> tuple[Any, Any]:
    """Allocate the buffers of :func:`walk` for a map of a shape."""
    most = sum(shape) + 3
    return np.empty(most + 1), np.empty(most, np.int64)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def walk(
    image: Any, heading: Any, begin: Any, stop: Any, origin: Any, voxel: Any, shape: Any, lengths: Any, voxels: Any
) -> Any:
    """Cut a straight segment at the faces of voxels.

    Parameters
    ----------
    image : ndarray of shape (3,), m
        The segment is part of the line ``image + length * heading``.
    heading : tuple of 3 floats
        Unit vector.
    begin, stop : float, m
        Path lengths at its ends.
    origin : ndarray of shape (3,), m
        Low corner of the map.
    voxel : float, m
    shape : tuple of 3 ints
        Voxels along each axis.
    lengths, voxels : ndarray
        Buffers of :func:`new_crossings`. Part k extends from ``lengths[k]`` to ``lengths[k + 1]`` in ``voxels[k]``, the
        index of the voxel in C order, -1 outside of the map. A part may be empty.

    Returns
    -------
    int
        Number of parts.
    """
    lengths[0] = begin
    enter, leave = begin, stop
    for i in range(3):
        low = origin[i] - image[i]
        high = low + shape[i] * voxel
        if heading[i] != 0.0:
            near, far = low / heading[i], high / heading[i]
            enter = max(enter, min(near, far))
            leave = min(leave, max(near, far))
        elif low > 0.0 or high < 0.0:
            leave = begin
    if leave <= enter:
        lengths[1], voxels[0] = stop, -1
        return 1
    count = 0
    if enter > begin:
        lengths[1], voxels[0] = enter, -1
        count = 1
    x, step_x, left_x, next_x, far_x = _axis(image[0], heading[0], enter, origin[0], voxel, shape[0])
    y, step_y, left_y, next_y, far_y = _axis(image[1], heading[1], enter, origin[1], voxel, shape[1])
    z, step_z, left_z, next_z, far_z = _axis(image[2], heading[2], enter, origin[2], voxel, shape[2])
    index = (x * shape[1] + y) * shape[2] + z
    step_x *= shape[1] * shape[2]
    step_y *= shape[2]
    length = enter
    while True:
        voxels[count] = index
        count += 1
        if next_x <= next_y and next_x <= next_z:
            length = max(length, next_x)
            index += step_x
            left_x -= 1
            next_x = next_x + far_x if left_x > 0 else np.inf
        elif next_y <= next_z:
            length = max(length, next_y)
            index += step_y
            left_y -= 1
            next_y = next_y + far_y if left_y > 0 else np.inf
        else:
            length = max(length, next_z)
            index += step_z
            left_z -= 1
            next_z = next_z + far_z if left_z > 0 else np.inf
        if length >= leave:
            break
        lengths[count] = length
    lengths[count] = leave
    if leave < stop:
        voxels[count] = -1
        count += 1
        lengths[count] = stop
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _axis(image: Any, heading: Any, enter: Any, origin: Any, voxel: Any, size: Any) -> Any:
    """Prepare the traversal along one axis.

    Returns
    -------
    first, step, left : int
        Voxel at the length ``enter``, the step to the next one, and the number of steps left.
    next_length, length : float, m
        Path length at the first change, and between changes.
    """
    first = int(np.floor((image + enter * heading - origin) / voxel))
    first = min(max(first, 0), size - 1)
    step = 1 if heading > 0.0 else -1
    left = size - 1 - first if heading > 0.0 else first
    if heading == 0.0 or left == 0:
        return first, step, left, np.inf, np.inf
    face = origin + (first + (1 if heading > 0.0 else 0)) * voxel
    return first, step, left, (face - image) / heading, voxel / abs(heading)


@numba.njit(cache=True, nogil=True)
def power(base: Any, exponent: Any) -> Any:
    """Raise to a power of at least 0; fast for small integers, the usual case."""
    whole = int(exponent)
    if whole != exponent or whole > 4:
        return base**exponent
    product = 1.0
    for _ in range(whole):
        product *= base
    return product
