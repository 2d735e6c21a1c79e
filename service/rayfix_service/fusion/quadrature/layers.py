"""The prior in horizontal layers: uniform, or a Gaussian over the height that may be thinner than a layer."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_service.fusion.product.prior import Prior

_FAR = 6.5
"""Layers farther than this many standard deviations from a known height are left out."""

Array = NDArray[np.float64]


class Layers(NamedTuple):
    """What the prior is in the layers of some blocks.

    Attributes
    ----------
    keep : ndarray of bool, shape (n,), or None
        Blocks whose layers are not left out; the other attributes are of these. None stands for all of them.
    log_density : ndarray of shape (k,)
        Natural logarithm of the prior's mean density in the layer, 1 / m3.
    middle : ndarray of shape (k,), m
        Mean height there.
    height : ndarray of shape (k,), m
        Of a layer in which a uniform height would vary as much.
    """

    keep: NDArray[np.bool_] | None
    log_density: Array
    middle: Array
    height: Array


def layers_of(prior: Prior, layer: NDArray[np.int64], lowest: float, thickness: float) -> Layers:
    """Integrate the prior over the layers of blocks.

    Parameters
    ----------
    layer : ndarray of int64, shape (n,)
        Number of each block's layer.
    lowest : float, m
        Where layer 0 begins.
    thickness : float, m
    """
    if prior.precision == 0.0:
        count = len(layer)
        return Layers(None, np.full(count, -prior.log_volume), np.empty(0), np.full(count, thickness))
    stdev, mean = prior.precision**-0.5, prior.eta / prior.precision
    first = max(int(layer.min(initial=0)), math.floor((mean - _FAR * stdev - lowest) / thickness))
    last = min(int(layer.max(initial=0)), math.floor((mean + _FAR * stdev - lowest) / thickness))
    if last < first:  # no layer is near: the nearest one stands for it
        first = last = int(layer[np.argmin(np.abs(lowest + thickness * (layer + 0.5) - mean))])
    rows = [_cut(lowest + thickness * n, thickness, mean, stdev) for n in range(first, last + 1)]
    log_mass, middle, variance = np.array(rows).T
    # The prior is exp(eta z - precision z^2 / 2 - log_volume), a normal density times this constant.
    log_scale = 0.5 * mean * prior.eta + math.log(math.sqrt(2.0 * math.pi) * stdev / thickness) - prior.log_volume
    keep = (layer >= first) & (layer <= last)
    at = layer[keep] - first
    return Layers(keep, log_mass[at] + log_scale, middle[at], np.sqrt(12.0 * variance)[at])


def _cut(low: float, thickness: float, mean: float, stdev: float) -> tuple[float, float, float]:
    """Log probability, mean and variance of a normal cut to a layer; far in a tail, of the point of it that is nearest.

    N. L. Johnson, S. Kotz, N. Balakrishnan, "Continuous Univariate Distributions", vol. 1, 1994, section 13.10.1.
    """
    a, b = (low - mean) / stdev, (low + thickness - mean) / stdev
    mirrored = a + b > 0.0
    if mirrored:
        a, b = -b, -a
    mass = 0.5 * (math.erfc(-b / math.sqrt(2.0)) - math.erfc(-a / math.sqrt(2.0)))
    if mass < 1e-280:
        near = b
        return -0.5 * near**2, mean + stdev * (-near if mirrored else near), (0.01 * thickness) ** 2
    at_a, at_b = (math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi) for x in (a, b))
    shift = (at_a - at_b) / mass
    variance = 1.0 + (a * at_a - b * at_b) / mass - shift**2
    middle = mean + stdev * (-shift if mirrored else shift)
    return math.log(mass), middle, max(variance * stdev**2, (0.01 * thickness) ** 2)
