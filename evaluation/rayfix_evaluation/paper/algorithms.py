"""The paper's Algorithm 1 and Algorithm 2, from points to one mixture over the position for each station."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.paper.mixtures import Mixture, condition_on_last, fit_mixture, where_all_meet
from rayfix_evaluation.paper.points import RayPoints
from rayfix_evaluation.paper.selection import RelativeLength, select_by_length, select_tuples

Order = Literal["select_first", "fit_first"]
"""Order of Algorithm 1's steps 3 (select by propagation time) and 4 (fit by EM)."""


@dataclass(frozen=True, kw_only=True)
class PaperSettings:
    """Settings of the paper's method.

    Attributes
    ----------
    num_rays : int
        Number of rays that are launched around a measured angle.
    num_isotropic_rays : int
        Number of rays that are launched in all directions if no angle was measured.
    step : float, m
        Distance between the points of a ray.
    num_points : int
        Largest number of points, or pairs of points, of a fit.
    num_components : int
        Number of components of each station's mixture.
    order : {"select_first", "fit_first"}
    bins_per_stdev : int
        Bins of path length per standard deviation of a relative propagation time.
    most_products : int
        Number of products of components that are kept after each station.
    """

    num_rays: int = 500
    num_isotropic_rays: int = 5000
    step: float = 0.1
    num_points: int = 2000
    num_components: int = 10
    order: Order = "select_first"
    bins_per_stdev: int = 4
    most_products: int = 10_000


def algorithm_1(
    points: RayPoints,
    measured: tuple[float, float] | None,
    settings: PaperSettings,
    rng: np.random.Generator,
) -> Mixture | None:
    """Fit a mixture over the position to one station's measurements.

    Parameters
    ----------
    points : RayPoints
        Points on the station's rays, from steps 1 and 2.
    measured : (length, stdev) or None, m
        Propagation time as a length, and its standard deviation.

    Returns
    -------
    Mixture or None
        Over the position; None if fewer than two points are left.
    """
    seed = int(rng.integers(2**31))
    if measured is None:
        return _fit(_thin(points, settings.num_points, rng).position, settings, seed)
    length, stdev = measured
    if settings.order == "select_first":
        selected = select_by_length(points, length, stdev, rng)
        return _fit(_thin(selected, settings.num_points, rng).position, settings, seed)
    thinned = _thin(points, settings.num_points, rng)
    joint = _fit(np.column_stack([thinned.position, thinned.path_length]), settings, seed)
    return joint and condition_on_last(joint, length, stdev**2)


def algorithm_2(
    reference: RayPoints,
    others: Sequence[RayPoints],
    differences: Sequence[RelativeLength],
    settings: PaperSettings,
    rng: np.random.Generator,
) -> list[Mixture] | None:
    """Fit a mixture over the position for each station, given relative propagation times.

    Parameters
    ----------
    reference : RayPoints
        Points of the station that the times are relative to.
    others : sequence of RayPoints
    differences : sequence of RelativeLength
        One for each of ``others``.

    Returns
    -------
    list of Mixture or None
        Of the reference and of each other station; None if no points' lengths agree with the times.
    """
    selected = _agreeing(reference, others, differences, settings, rng)
    if not len(selected[0]):
        return None
    return [fit_mixture(p.position, settings.num_components, int(rng.integers(2**31))) for p in selected]


def algorithm_2_joint(
    reference: RayPoints,
    others: Sequence[RayPoints],
    differences: Sequence[RelativeLength],
    settings: PaperSettings,
    rng: np.random.Generator,
) -> Mixture | None:
    """Algorithm 2 with a joint fit of the pairs: over all stations' positions, conditioned on their equality.

    Separate fits lose the association of one station's points with another's. The joint fit keeps it, and converges to
    the exact posterior with many points and components. Parameters are those of :func:`algorithm_2`.

    Returns
    -------
    Mixture or None
        Over the position, for all stations together.
    """
    selected = _agreeing(reference, others, differences, settings, rng)
    if not len(selected[0]):
        return None
    positions = np.concatenate([points.position for points in selected], axis=1)
    return where_all_meet(fit_mixture(positions, settings.num_components, int(rng.integers(2**31))))


def _agreeing(
    reference: RayPoints,
    others: Sequence[RayPoints],
    differences: Sequence[RelativeLength],
    settings: PaperSettings,
    rng: np.random.Generator,
) -> list[RayPoints]:
    return select_tuples(
        reference,
        others,
        differences,
        count=settings.num_points,
        bins_per_stdev=settings.bins_per_stdev,
        rng=rng,
    )


def _fit(samples: NDArray[np.float64], settings: PaperSettings, seed: int) -> Mixture | None:
    return fit_mixture(samples, settings.num_components, seed) if len(samples) >= 2 else None


def _thin(points: RayPoints, most: int, rng: np.random.Generator) -> RayPoints:
    """Draw at most ``most`` points without replacement."""
    if len(points) <= most:
        return points
    return points.take(rng.choice(len(points), size=most, replace=False))
