"""Components of a compact mixture in double precision, for kernels; the plain twin is ``CompactTubes.expanded``."""

from typing import Any

import numba
import numpy as np

from rayfix_tables.compact.tubes import WEIGHT_STEPS, CompactTubes
from rayfix_tables.mixture import TubeMixture, Tubes

_STEP = 1.0 / WEIGHT_STEPS


@numba.njit(cache=True, nogil=True)
def half(bits: Any) -> Any:
    """Finite number of half precision from its bits, in double precision.

    In whole numbers, since numba has no half precision, and a processor may be set to take small numbers for 0.
    """
    whole = np.int64(bits)
    exponent = (whole >> 10) & 31
    value = np.float64(whole & 1023)
    if exponent:
        value = (value + 1024.0) * np.float64(np.int64(1) << exponent) * 2.0**-25
    else:
        value *= 2.0**-24
    return -value if whole >> 15 else value


@numba.njit(cache=True, nogil=True)
def _square(root: Any, k: Any, scale: Any, cov: Any, row: Any) -> None:
    """Packed covariance of a root whose last two rows are in units of ``scale``."""
    l00 = half(root[k, 0])
    l10, l11 = half(root[k, 1]) * scale, half(root[k, 2]) * scale
    l20, l21, l22 = half(root[k, 3]) * scale, half(root[k, 4]) * scale, half(root[k, 5]) * scale
    cov[row, 0] = l00 * l00
    cov[row, 1] = l00 * l10
    cov[row, 2] = l00 * l20
    cov[row, 3] = l10 * l10 + l11 * l11
    cov[row, 4] = l10 * l20 + l11 * l21
    cov[row, 5] = l20 * l20 + l21 * l21 + l22 * l22


@numba.njit(cache=True, nogil=True)
def no_tubes(count: Any) -> Any:
    """Arrays for :func:`expand`, of this many components."""
    return Tubes(
        np.empty(count),
        np.empty((count, 3)),
        np.empty((count, 6)),
        np.empty((count, 3)),
        np.empty((count, 3, 3)),
        np.empty((count, 6)),
    )


@numba.njit(cache=True, nogil=True)
def expand(stored: Any, window: Any, begins: Any, ends: Any, out: Any) -> None:
    """Expand the components of ranges, one range after the other.

    Parameters
    ----------
    stored : CompactArrays
    window : float, rad
    begins, ends : ndarray of int64, shape (n,)
    out : Tubes
        Of double precision; filled.
    """
    log_weight16, length, angles16, u_root16, place, slopes16, x_root16 = stored
    log_weight, u_mean, u_cov, x_mean, jacobian, x_cov = out
    row = 0
    for n in range(len(begins)):
        for k in range(begins[n], ends[n]):
            log_weight[row] = -_STEP * log_weight16[k]
            u_mean[row, 0] = length[k]
            u_mean[row, 1] = half(angles16[k, 0]) * window
            u_mean[row, 2] = half(angles16[k, 1]) * window
            for i in range(3):
                x_mean[row, i] = place[k, i]
                jacobian[row, i, 0] = half(slopes16[k, i, 0])
                jacobian[row, i, 1] = half(slopes16[k, i, 1]) * length[k]
                jacobian[row, i, 2] = half(slopes16[k, i, 2]) * length[k]
            _square(u_root16, k, window, u_cov, row)
            _square(x_root16, k, 1.0, x_cov, row)
            row += 1


def expanded_tubes(mixture: TubeMixture | CompactTubes, begin: int, end: int) -> Tubes:
    """Return a range of components for kernels that take no compact ones: as they are, or in double precision."""
    if isinstance(mixture, TubeMixture):
        return mixture[begin:end].tubes
    out: Tubes = no_tubes(end - begin)
    expand(tuple(mixture.arrays), mixture.window, np.array([begin]), np.array([end]), out)
    return out
