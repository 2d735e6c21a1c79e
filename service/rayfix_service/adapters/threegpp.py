"""A position as 3GPP's "local 3D point with uncertainty ellipsoid"."""

import math
from typing import Any

import numpy as np

from rayfix_service.adapters.positions import best_candidate
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.tracking.track import TrackedPosition
from rayfix_tables.site import SiteInfo


def fix_to_3gpp(fix: Fix, site: SiteInfo, track: TrackedPosition | None = None) -> dict[str, Any]:
    """Describe the best candidate of a fix as Local3dPointUncertaintyEllipsoid (TS 29.572, clause 6.1.6.2).

    ``point`` is in the scene frame, whose origin ``localOrigin`` names by the site's name;
    ``horizAxesOrientation`` is the bearing of the scene's +y axis, clockwise from north, in 0.1 deg. The semi-axes
    are those of the upright ellipsoid that holds the target with the probability ``confidence``, in percent;
    ``orientationMajor`` is the bearing of the major one, 0 to 179 deg clockwise from north (TS 23.032, clause 6.1).
    With a track, it is the track's position.

    Raises
    ------
    ReportError
        When the fix has no position.
    """
    candidate, regions = best_candidate(fix, track)
    x, y, z = candidate.position.tolist()
    ellipsoid = regions.upright_ellipsoid(fix.confidence)
    (minor, major), axes = np.linalg.eigh(ellipsoid.shape[:2, :2])
    bearing = math.degrees(site.north - math.atan2(axes[1, 1], axes[0, 1]))
    return {
        "shape": "LOCAL_3D_POINT_UNCERTAINTY_ELLIPSOID",
        "localOrigin": {
            "coordinateId": site.name,
            "horizAxesOrientation": round(10.0 * (math.degrees(site.north) - 90.0)) % 3600,
        },
        "point": {"x": x, "y": y, "z": z},
        "uncertaintyEllipsoid": {
            "semiMajor": math.sqrt(major),
            "semiMinor": math.sqrt(minor),
            "vertical": math.sqrt(ellipsoid.shape[2, 2]),
            "orientationMajor": round(bearing) % 180,
        },
        "confidence": round(100.0 * ellipsoid.probability),
    }
