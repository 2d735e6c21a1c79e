"""A position as 3GPP's "local 3D point with uncertainty ellipsoid"."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_service.adapters.positions import best_candidate
from rayfix_service.fusion.report import Fix
from rayfix_service.wire import CONFIDENCE
from rayfix_tables.site import SiteInfo

# Directions u over an eighth of the sphere, which the squares of their coordinates repeat: Gauss-Legendre in
# cos(angle to the third axis), midpoints about it.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_T = 0.5 * (_NODES + 1.0)[:, np.newaxis]
_PHI = (np.arange(24) + 0.5) * (0.5 * np.pi / 24)
_SQUARES = (1.0 - _T**2) * np.cos(_PHI) ** 2 - _T**2
_SHARES = np.broadcast_to(0.5 * _WEIGHTS[:, np.newaxis] / 24, _SQUARES.shape)

_erf = np.vectorize(math.erf, otypes=[float])


def fix_to_3gpp(fix: Fix, site: SiteInfo) -> dict[str, Any]:
    """Describe the best candidate of a fix as Local3dPointUncertaintyEllipsoid (TS 29.572, clause 6.1.6.2).

    ``point`` is in the scene frame, whose origin ``localOrigin`` names by the site's name;
    ``horizAxesOrientation`` is the bearing of the scene's +y axis, clockwise from north, in 0.1 deg. The semi-axes
    are those of the ellipsoid that holds the target with a probability of 0.68, given that the candidate is the
    right one; ``orientationMajor`` is the bearing of the major one, 0 to 179 deg clockwise from north (TS 23.032,
    clause 6.1). ``confidence`` is the probability of both, in percent: the candidate's probability times 0.68.

    Raises
    ------
    ReportError
        When the fix has no position.
    """
    candidate = best_candidate(fix)
    x, y, z = candidate.position.tolist()
    cov = candidate.covariance
    (minor, major), axes = np.linalg.eigh(cov[:2, :2])
    bearing = math.degrees(site.north - math.atan2(axes[1, 1], axes[0, 1]))
    scale = ellipsoid_scale(cov)
    return {
        "shape": "LOCAL_3D_POINT_UNCERTAINTY_ELLIPSOID",
        "localOrigin": {
            "coordinateId": site.name,
            "horizAxesOrientation": round(10.0 * (math.degrees(site.north) - 90.0)) % 3600,
        },
        "point": {"x": x, "y": y, "z": z},
        "uncertaintyEllipsoid": {
            "semiMajor": scale * math.sqrt(max(major, 0.0)),
            "semiMinor": scale * math.sqrt(max(minor, 0.0)),
            "vertical": scale * math.sqrt(max(cov[2, 2], 0.0)),
            "orientationMajor": round(bearing) % 180,
        },
        "confidence": round(100.0 * CONFIDENCE * candidate.probability),
    }


def ellipsoid_scale(covariance: NDArray[np.float64], confidence: float = CONFIDENCE) -> float:
    """Length of an upright ellipsoid's semi-axes in standard deviations, for it to hold `confidence`.

    The ellipsoid's third axis is vertical, so that it follows the horizontal and the vertical marginal of a
    Gaussian, not the correlation between them. Scaled to unit marginals, the Gaussian has the variances 1 + r, 1
    and 1 - r with the canonical correlation r of horizontal and vertical, and the probability within radius s is
    the mean of the chi-square distribution (3 degrees of freedom) at s^2 / g over all directions u,
    g = 1 + r (u_1^2 - u_3^2). Newton's method solves it.

    Parameters
    ----------
    covariance : ndarray of shape (3, 3), m2
    confidence : float
        Between 0 and 1.
    """
    values, axes = np.linalg.eigh(covariance[:2, :2])
    shared = axes.T @ covariance[:2, 2]
    good = values > 1e-12 * max(values[-1], 1e-300)
    vertical = max(float(covariance[2, 2]), 1e-300)
    r = math.sqrt(min(float((shared[good] ** 2 / values[good]).sum()) / vertical, 1.0 - 1e-9))
    g = 1.0 + r * _SQUARES
    squared = 3.0
    for _ in range(60):
        t = squared / g
        tail = np.sqrt(2.0 * t / np.pi) * np.exp(-0.5 * t)
        inside = float((_SHARES * (_erf(np.sqrt(0.5 * t)) - tail)).sum())
        step = (confidence - inside) / float((_SHARES * 0.5 * tail / g).sum())
        squared = max(squared + step, 0.5 * squared)
        if abs(step) <= 1e-10 * squared:
            break
    return math.sqrt(squared)
