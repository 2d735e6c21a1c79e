"""``fit = "em"``: cells fitted by expectation-maximisation on sampled points, as in the paper.

Points are drawn from the weighted ray pieces of a cell. A Gaussian mixture with full covariances is fitted to their
path length, angles and position; its number of components has the least BIC.
"""

import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture
from threadpoolctl import threadpool_limits

from rayfix_offline.fit.settings import ExpectationMaximisation, RayFit
from rayfix_offline.fit.tubes import Fitted, Labels, fitted_cells
from rayfix_offline.rays.trace import LevelRays
from rayfix_tables.geometry.angles import tangent, wrap
from rayfix_tables.mixture import TubeMixture


def fit_em(
    centres: NDArray[np.float64], cells: NDArray[np.int64], level: LevelRays, fit: ExpectationMaximisation
) -> Fitted:
    """Fit a block of cells.

    Parameters
    ----------
    centres : ndarray of shape (n_cells, 2), rad
    cells : ndarray of int64, shape (n_cells,)
        Numbers of the cells, for their seeds.
    """
    counts, dropped = np.zeros(len(cells), np.int64), np.zeros(len(cells), np.int64)
    log_mass = np.full(len(cells), -np.inf)
    parts = []
    with threadpool_limits(limits=1):
        for n, (centre, cell) in enumerate(zip(centres, cells, strict=True)):
            rng = np.random.default_rng([fit.seed, int(cell)])
            points, labels, mass = sample_points(centre, level, fit.num_points, rng, cutoff=fit.cutoff)
            if not len(points):
                continue
            part = _fit_points(np.log(mass), points, labels, fit, int(rng.integers(2**31)))
            counts[n], log_mass[n], dropped[n] = part.counts[0], part.log_mass[0], part.dropped[0]
            parts.append(part.mixture)
    return Fitted(counts, log_mass, TubeMixture.concatenate(parts), dropped)


def sample_points(
    centre: NDArray[np.float64],
    level: LevelRays,
    count: int,
    rng: np.random.Generator,
    *,
    cutoff: float = RayFit.cutoff,
) -> tuple[NDArray[np.float64], Labels, float]:
    """Draw points from the measure of a cell.

    Parameters
    ----------
    cutoff : float
        Rays are gathered within this many standard deviations of the window.

    Returns
    -------
    points : ndarray of shape (count, 6)
        (path length, horizontal and vertical angle, x, y, z); none if no ray reaches the cell.
    labels : Labels
        Of shape (count,).
    mass : float
        The cell's mass.
    """
    rays, pieces, sequences = level.rays, level.pieces, level.sequences
    reach = cutoff * level.window
    near = np.flatnonzero(
        (np.abs(rays.zenith - centre[1]) <= reach)
        & (np.abs(wrap(rays.azimuth - centre[0])) * np.sin(centre[1]) <= reach)
    )
    offset = tangent(rays.azimuth[near], rays.zenith[near], centre[0], centre[1])
    square = np.einsum("ij,ij->i", offset, offset) / level.window**2
    inside = square <= cutoff**2
    near, offset, square = near[inside], offset[inside], square[inside]
    density = np.exp(-0.5 * square) / (2.0 * np.pi * level.window**2) * rays.solid_angle[near]
    chosen = pieces.of_rays(near)
    ray = np.repeat(np.arange(len(near)), np.diff(chosen.offsets))
    weight = density[ray] * chosen.mass
    mass = float(weight.sum())
    if mass <= 0.0:
        return np.zeros((0, 6)), Labels(np.zeros(0, np.int8), np.zeros(0, np.int8)), 0.0
    drawn = rng.choice(len(weight), size=count, p=weight / mass)
    # A ray represents a solid angle, and a piece an interval of lengths.
    half = np.sqrt(3.0 * chosen.variance[drawn])
    length = chosen.mean[drawn] + half * rng.uniform(-1.0, 1.0, count)
    jitter = rng.uniform(-0.5, 0.5, (count, 2)) * level.ray_spacing
    at = offset[ray[drawn]] + jitter
    azimuth = centre[0] + at[:, 0] / np.sin(centre[1])
    zenith = centre[1] + at[:, 1]
    sine = np.sin(zenith)
    launched = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)
    sequence = chosen.sequence[drawn]
    position = sequences.images[sequence] + length[:, None] * np.einsum(
        "nij,nj->ni", sequences.mirrors[sequence], launched
    )
    measured = length + chosen.excess[drawn]
    points = np.concatenate([measured[:, None], at, position], axis=1)
    return points, Labels(sequences.num_reflections[sequence], chosen.num_walls[drawn]), mass


def _fit_points(
    log_mass: float,
    points: NDArray[np.float64],
    labels: Labels,
    fit: ExpectationMaximisation,
    seed: int,
) -> Fitted:
    """Fit one cell."""
    scale = np.maximum(points.std(axis=0), fit.min_scale)
    scaled = (points - points.mean(axis=0)) / scale
    best: tuple[float, GaussianMixture] | None = None
    for num_components in fit.num_components:
        mixture = GaussianMixture(
            num_components, reg_covar=fit.regularisation, random_state=seed, max_iter=fit.max_rounds
        )
        with warnings.catch_warnings():
            # A mixture that has not converged after the last round is judged by its BIC like any other.
            warnings.simplefilter("ignore", ConvergenceWarning)
            mixture.fit(scaled)
        bic = float(mixture.bic(scaled))
        if best is None or bic < best[0]:
            best = (bic, mixture)
    assert best is not None
    chosen = best[1]
    floor = np.array([0.0, 0.0, 0.0, fit.position_floor, fit.position_floor, fit.position_floor]) ** 2
    cov = chosen.covariances_ * np.outer(scale, scale) + np.diag(floor)
    member = chosen.predict(scaled)
    own = Labels(*(_most_frequent(column, member, len(chosen.weights_)) for column in labels))
    found = fitted_cells(
        np.array([len(chosen.weights_)]),
        np.array([log_mass]),
        np.log(np.maximum(chosen.weights_, fit.min_weight)),
        chosen.means_ * scale + points.mean(axis=0),
        cov,
        own,
        position_floor=fit.position_floor,
    )
    # The floor of the length lies along the tube, so that it adds to u_cov only.
    u_cov = found.mixture.u_cov.copy()
    u_cov[:, 0] += fit.length_floor**2
    return found._replace(mixture=replace(found.mixture, u_cov=u_cov))


def _most_frequent(labels: NDArray[np.int8], member: NDArray[np.int64], count: int) -> NDArray[np.int8]:
    """Most frequent label of the points of each component, 0 without points."""
    return np.array(
        [np.bincount(labels[member == k]).argmax() if np.any(member == k) else 0 for k in range(count)], np.int8
    )
