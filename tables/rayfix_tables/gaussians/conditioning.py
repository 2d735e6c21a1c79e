"""Components of cells conditioned on a measured angle; used by the fusion and by the normalisation."""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.gaussians.constants import LOG_2PI

Array = NDArray[np.float64]


class MeasuredCells(NamedTuple):
    """Cells of a level, and the rest of a measured angle after removal of each cell's window.

    Attributes
    ----------
    begins, ends : ndarray of int64, shape (n,)
        Components of cell ``c`` are those from ``begins[c]`` to ``ends[c]``.
    rest_mean : ndarray of shape (n, 2), rad
    rest_cov : ndarray of shape (n, 3), rad2
        Packed: horizontal variance, covariance, vertical variance.
    log_factor : ndarray of shape (n,)
        Added to the logarithms of all weights of a cell.
    """

    begins: NDArray[np.int64]
    ends: NDArray[np.int64]
    rest_mean: Array
    rest_cov: Array
    log_factor: Array


class Conditioned(NamedTuple):
    """Gaussians over (x, path length), a row for each component, cell after cell.

    Attributes
    ----------
    log_evidence : ndarray of shape (k,)
    mean : ndarray of shape (k, 4), m
    cov : ndarray of shape (k, 4, 4), m2
        Positive definite: the position of a component given its ray is nowhere exact.
    """

    log_evidence: Array
    mean: Array
    cov: Array


@numba.njit(cache=True, nogil=True)
def condition_on_angle(tubes: Any, cells: Any, out: Any) -> None:
    """Condition the components of cells on the rest of the measured angle.

    Parameters
    ----------
    tubes : Tubes
        Of a :class:`~rayfix_tables.mixture.TubeMixture`; their covariances are positive definite.
    cells : MeasuredCells
    out : Conditioned
        Filled.
    """
    log_weight, u_mean, u_cov, x_mean, jacobian, x_cov = tubes
    begins, ends, rest_mean, rest_cov, log_factor = cells
    out_log, out_mean, out_cov = out
    u = np.empty(3)
    cov = np.empty((3, 3))
    cross = np.empty((3, 3))
    slope = np.empty((3, 3))
    row = 0
    for c in range(len(begins)):
        for k in range(begins[c], ends[c]):
            p00, p01, p02 = np.float64(u_cov[k, 0]), np.float64(u_cov[k, 1]), np.float64(u_cov[k, 2])
            p11, p12, p22 = np.float64(u_cov[k, 3]), np.float64(u_cov[k, 4]), np.float64(u_cov[k, 5])
            s11, s12, s22 = p11 + rest_cov[c, 0], p12 + rest_cov[c, 1], p22 + rest_cov[c, 2]
            det = s11 * s22 - s12 * s12
            i11, i12, i22 = s22 / det, -s12 / det, s11 / det
            r1 = rest_mean[c, 0] - u_mean[k, 1]
            r2 = rest_mean[c, 1] - u_mean[k, 2]
            g1 = i11 * r1 + i12 * r2
            g2 = i12 * r1 + i22 * r2
            out_log[row] = log_factor[c] + log_weight[k] - 0.5 * (r1 * g1 + r2 * g2 + np.log(det)) - LOG_2PI
            column1 = (p01, p11, p12)
            column2 = (p02, p12, p22)
            prior = ((p00, p01, p02), (p01, p11, p12), (p02, p12, p22))
            for i in range(3):
                u[i] = column1[i] * g1 + column2[i] * g2
                k1 = column1[i] * i11 + column2[i] * i12
                k2 = column1[i] * i12 + column2[i] * i22
                for j in range(3):
                    cov[i, j] = prior[i][j] - k1 * column1[j] - k2 * column2[j]
            # The widening: at the new mean, the tube's direction differs, and its slopes belong to another length.
            length = np.float64(u_mean[k, 0])
            stretch = 1.0 + u[0] / length
            for i in range(3):
                moved = np.float64(x_mean[k, i])
                along = np.float64(jacobian[k, i, 0])
                for a in range(1, 3):
                    widening = jacobian[k, i, a] / length
                    moved += jacobian[k, i, a] * u[a] + widening * (u[0] * u[a] + cov[0, a] - prior[0][a])
                    along += widening * u[a]
                    slope[i, a] = jacobian[k, i, a] * stretch
                slope[i, 0] = along
                out_mean[row, i] = moved + jacobian[k, i, 0] * u[0]
                for j in range(3):
                    cross[i, j] = along * cov[0, j] + slope[i, 1] * cov[1, j] + slope[i, 2] * cov[2, j]
            out_mean[row, 3] = u_mean[k, 0] + u[0]
            packed = 0
            for i in range(3):
                for j in range(i, 3):
                    total = np.float64(x_cov[k, packed])
                    packed += 1
                    for m in range(3):
                        total += cross[i, m] * slope[j, m]
                    for a in range(1, 3):
                        for b in range(1, 3):
                            products = cov[0, 0] * cov[a, b] + cov[0, a] * cov[0, b]
                            total += products * jacobian[k, i, a] * jacobian[k, j, b] / (length * length)
                    out_cov[row, i, j] = total
                    out_cov[row, j, i] = total
                out_cov[row, i, 3] = cross[i, 0]
                out_cov[row, 3, i] = cross[i, 0]
            out_cov[row, 3, 3] = cov[0, 0]
            row += 1
