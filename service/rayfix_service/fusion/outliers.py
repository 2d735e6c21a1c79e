"""How probable it is that a measurement has nothing to do with the position."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.factor_kernels import ALL_OUTLIER, TIME_OUTLIER
from rayfix_service.fusion.observations import Observation


def outlier_probabilities(
    observations: Sequence[Observation], outlier: NDArray[np.int8], weight: NDArray[np.float64], lost: float
) -> tuple[dict[int, float], float]:
    """Posterior probabilities of outliers.

    Parameters
    ----------
    outlier : ndarray of int8, shape (h, n)
        What each hypothesis takes for an outlier in each observation.
    weight : ndarray of shape (h,)
        Posterior probabilities of the hypotheses.
    lost : float
        Posterior probability that everything is an outlier.

    Returns
    -------
    dict of int to float
        Of each used measurement to be an outlier, by its place in the report.
    float
        Of at least half of the observations to be outliers altogether.
    """
    # A time difference is as bad as the worse of its two times.
    places: dict[int, list[tuple[int, int]]] = {}
    for n, observation in enumerate(observations):
        if observation.angle_index is not None:
            places[observation.angle_index] = [(n, ALL_OUTLIER)]
        for index in (*observation.timing_indices, *observation.differences):
            places.setdefault(index, []).append((n, TIME_OUTLIER))
    rows = [(row, *place) for row, own in enumerate(places.values()) for place in own]
    total, half_bad = _sum_up(outlier, weight, lost, np.array(rows), len(places))
    return dict(zip(places, total.tolist(), strict=True)), half_bad


@numba.njit(cache=True, nogil=True)
def _sum_up(outlier: Any, weight: Any, lost: Any, rows: Any, count: Any) -> Any:
    """Sum the weights of the hypotheses that hold a measurement for an outlier.

    Parameters
    ----------
    rows : ndarray of int64, shape (r, 3)
        Measurement, observation, and the least that the observation's outlier must be.
    count : int
        Number of measurements.

    Returns
    -------
    total : ndarray of shape (count,)
    half_bad : float
        The same for at least half of the observations.
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
