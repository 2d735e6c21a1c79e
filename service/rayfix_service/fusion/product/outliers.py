"""How probable it is that a measurement has nothing to do with the position."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.observations import Observation
from rayfix_service.fusion.product.factor_kernels import ALL_OUTLIER, TIME_OUTLIER


class OutlierIndex(NamedTuple):
    """What in a hypothesis makes each measurement an outlier.

    Attributes
    ----------
    places : list of int
        Indices of the used measurements in the report.
    rows : ndarray of int64, shape (r, 3)
        Index of a measurement in ``places``, an observation, and the least value of the observation's outlier for it.
    """

    places: list[int]
    rows: NDArray[np.int64]


def outlier_index(observations: Sequence[Observation]) -> OutlierIndex:
    """Which outliers of the observations make which measurements of the report outliers."""
    # A time difference is as bad as the worse of its two times.
    number: dict[int, int] = {}
    rows = []
    for n, observation in enumerate(observations):
        if observation.angle_index is not None:
            rows.append((number.setdefault(observation.angle_index, len(number)), n, ALL_OUTLIER))
        times = (*observation.timing_indices, *observation.differences)
        rows += [(number.setdefault(index, len(number)), n, TIME_OUTLIER) for index in times]
    return OutlierIndex(list(number), np.array(rows))


@numba.njit(cache=True, nogil=True)
def outlier_probabilities(outlier: Any, weight: Any, lost: Any, rows: Any, count: Any) -> Any:
    """Posterior probabilities of outliers.

    Parameters
    ----------
    outlier : ndarray of int8, shape (h, n)
        What each hypothesis takes for an outlier in each observation.
    weight : ndarray of shape (h,)
        Posterior probabilities of the hypotheses.
    lost : float
        Posterior probability that everything is an outlier.
    rows : ndarray of int64, shape (r, 3)
        As in :class:`OutlierIndex`.
    count : int
        Number of measurements there.

    Returns
    -------
    total : ndarray of shape (count,)
        Of each measurement to be an outlier.
    half_bad : float
        Of at least half of the observations to be outliers altogether.
    """
    total, half_bad = np.full(count, lost), lost
    bad = np.empty(count, np.bool_)
    for h in range(len(weight)):
        bad[:] = False
        for r in range(len(rows)):
            bad[rows[r, 0]] |= outlier[h, rows[r, 1]] >= rows[r, 2]
        if 2 * np.count_nonzero(outlier[h] == ALL_OUTLIER) >= outlier.shape[1]:
            half_bad += weight[h]
        for n in range(count):
            if bad[n]:
                total[n] += weight[h]
    return np.minimum(total, 1.0), half_bad
