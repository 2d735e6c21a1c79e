"""Checks of values that the kernels rely on: finite numbers, and indices within range."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.compact.tubes import DIAGONAL

_AT_A_TIME = 1 << 17
"""Numbers that are checked at a time, to keep temporary copies small."""

_HALF_MAGNITUDE, _HALF_INFINITY = np.uint16(0x7FFF), np.uint16(0x7C00)
"""Bits of a number of half precision without its sign; what is not finite is at least infinity's."""


def check_finite(arrays: Iterable[tuple[str, NDArray[Any]]]) -> None:
    """Check that all numbers are finite, except logarithms of a cell's mass, which may be -inf.

    Lengths of compact components and diagonals of their roots must be positive, too.

    Raises
    ------
    ValueError
        When an array has others; the message names it.
    """
    for name, array in arrays:
        if array.dtype.kind != "f":
            continue
        flat, empty_cells = array.reshape(-1), name.endswith("/cell_log_mass")
        for begin in range(0, flat.size, _AT_A_TIME):
            part = flat[begin : begin + _AT_A_TIME]
            if array.dtype == np.float16:  # of which NumPy asks ten times as slowly
                good = (part.view(np.uint16) & _HALF_MAGNITUDE).max() < _HALF_INFINITY
            else:
                good = (np.isfinite(part) | (part == -np.inf) if empty_cells else np.isfinite(part)).all()
            if not good:
                raise ValueError(f"{name} has numbers that are not finite")
        _check_positive(name, array)


def _check_positive(name: str, array: NDArray[Any]) -> None:
    """Check what compact components are divided by: their lengths, and the diagonals of their roots."""
    field = name.rpartition("/")[2]
    if field == "length":
        divisors = array
    elif field in ("u_root16", "x_root16"):
        divisors = array[:, DIAGONAL]
    else:
        return
    if array.size and not float(divisors.min()) > 0.0:
        raise ValueError(f"{name} has numbers that are not positive")


def check_range(name: str, array: NDArray[Any], least: int, most: int) -> None:
    """Check that all numbers of an array of integers are in a range.

    Raises
    ------
    ValueError
        When one is not; the message names the array.
    """
    if array.size and not (least <= int(array.min()) and int(array.max()) <= most):
        raise ValueError(f"{name} has numbers that are not from {least} to {most}")


def check_rings(name: str, ring_cells: NDArray[np.int64], num_cells: int) -> None:
    """Check that each ring of a grid has at least one cell and at most this many.

    Raises
    ------
    ValueError
        When this does not hold; the message names the array.
    """
    if not len(ring_cells):
        raise ValueError(f"{name} has no ring")
    check_range(name, ring_cells, 1, max(num_cells, 1))


def check_offsets(name: str, offsets: NDArray[np.int64], count: int) -> None:
    """Check that offsets ascend from 0 to a number of components.

    Raises
    ------
    ValueError
        When they do not; the message names the array.
    """
    ends = len(offsets) > 0 and int(offsets[0]) == 0 and int(offsets[-1]) == count
    if not ends or np.any(offsets[1:] < offsets[:-1]):  # differences of damaged offsets may overflow
        raise ValueError(f"{name} do not run from 0 to {count}")
