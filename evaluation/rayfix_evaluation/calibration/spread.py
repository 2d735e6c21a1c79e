"""The spread of errors: a contaminated Gaussian, and errors that have nothing to do with the truth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Spread", "fit_spread", "log_density"]

Array = NDArray[np.float64]

_LEAST_SHARE = 0.02
_ROUNDS = 200


@dataclass(frozen=True, kw_only=True)
class Spread:
    """How errors of d quantities that go astray together are spread.

    Attributes
    ----------
    stdev : tuple of d floats
        Standard deviations of the narrow Gaussian.
    tail_share, tail_scale : float
        Of the wider one, as in an error model of a report.
    outlier_share : float
        Of errors that are spread evenly.
    """

    stdev: tuple[float, ...]
    tail_share: float
    tail_scale: float
    outlier_share: float


def log_density(errors: Array, spread: Spread, volume: float, extra: Array | None = None) -> Array:
    """Log density of errors, shape (n,).

    Parameters
    ----------
    errors : ndarray of shape (n, d)
    spread : Spread
    volume : float
        Of the range over which outliers are spread.
    extra : ndarray of shape (n, d), optional
        Standard deviations that come on top.
    """
    return np.asarray(np.logaddexp.reduce(_parts(errors, spread, volume, extra), axis=0))


def fit_spread(
    errors: Array, volume: float, weights: Array | None = None, *, tails: tuple[float, float] | None = None
) -> Spread:
    """Fit the spread by expectation-maximisation.

    Tails are kept where the evidence pays for two more numbers, by the Bayesian information criterion.

    Parameters
    ----------
    errors : ndarray of shape (n, d)
        Without their systematic parts.
    volume : float
    weights : ndarray of shape (n,), optional
        What each is worth in independent errors.
    tails : tuple of float, optional
        Their share and scale where they are known; the deviation alone is fitted then.
    """
    w = np.ones(len(errors)) if weights is None else weights
    scale = 1.4826 * np.maximum(_median(np.abs(errors), w), 1e-9)
    if tails is not None:
        start = Spread(stdev=tuple(scale.tolist()), tail_share=tails[0], tail_scale=tails[1], outlier_share=0.02)
        return _maximised(errors, start, volume, w, tails_known=True)
    narrow = Spread(stdev=tuple(scale.tolist()), tail_share=0.0, tail_scale=1.0, outlier_share=0.02)
    wide = Spread(stdev=tuple(scale.tolist()), tail_share=0.15, tail_scale=3.0, outlier_share=0.01)
    found = [_maximised(errors, start, volume, w) for start in (narrow, wide)]
    gaussian, heavy = (float(w @ log_density(errors, spread, volume)) for spread in found)
    useful = _LEAST_SHARE < found[1].tail_share < 0.5 and heavy - gaussian > np.log(max(w.sum(), 2.0))
    return found[1] if useful else found[0]


def _maximised(errors: Array, spread: Spread, volume: float, w: Array, *, tails_known: bool = False) -> Spread:
    tails = spread.tail_share > 0.0 and not tails_known
    for _ in range(_ROUNDS):
        parts = _parts(errors, spread, volume, None)
        share = np.exp(parts - np.logaddexp.reduce(parts, axis=0)) * w
        total = share.sum(axis=1)
        shrunk = share[0] + share[1] / spread.tail_scale**2
        variance = shrunk @ np.square(errors) / max(total[0] + total[1], 1e-12)
        stdev = np.sqrt(np.maximum(variance, 1e-18))
        scale = spread.tail_scale
        if tails and total[1] > 1e-9:
            squares = np.square(errors / stdev).mean(axis=1)
            scale = float(np.clip(np.sqrt(share[1] @ squares / total[1]), 1.5, 20.0))
        new = Spread(
            stdev=tuple(stdev.tolist()),
            tail_share=float(total[1] / max(total[0] + total[1], 1e-12)) if tails else spread.tail_share,
            tail_scale=scale,
            outlier_share=float(np.clip(total[2] / total.sum(), 1e-4, 0.5)),
        )
        change = abs(new.tail_share - spread.tail_share) + abs(new.tail_scale - spread.tail_scale)
        change += float(np.abs(np.subtract(new.stdev, spread.stdev) / stdev).max())
        spread = new
        if change < 1e-5:
            break
    return spread


def _parts(errors: Array, spread: Spread, volume: float, extra: Array | None) -> Array:
    """Log densities of the narrow and the wide Gaussian and of outliers, each times its share, shape (3, n)."""
    stdev = np.broadcast_to(np.asarray(spread.stdev), errors.shape)
    rows = []
    for scale, share in ((1.0, 1.0 - spread.tail_share), (spread.tail_scale, spread.tail_share)):
        wide = scale * stdev if extra is None else np.hypot(scale * stdev, extra)
        density = -0.5 * np.square(errors / wide).sum(axis=1) - np.log(wide).sum(axis=1)
        rows.append(density + np.log(max(share, 1e-300)))
    normal = 0.5 * errors.shape[1] * np.log(2.0 * np.pi)
    rows = [row - normal + np.log1p(-spread.outlier_share) for row in rows]
    rows.append(np.full(len(errors), np.log(spread.outlier_share) - np.log(volume)))
    return np.stack(rows)


def _median(values: Array, w: Array) -> Array:
    """Weighted median of each column."""
    found = []
    for column in values.T:
        order = np.argsort(column)
        total = np.cumsum(w[order])
        found.append(column[order][np.searchsorted(total, 0.5 * total[-1])])
    return np.array(found)
