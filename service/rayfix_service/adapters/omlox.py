"""A position as a location object of omlox hubs (omlox Hub API, version 2)."""

import math
from typing import Any

from rayfix_service.adapters.positions import best_candidate
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.measuring.timestamps import utc_milliseconds
from rayfix_service.tracking.track import TrackedPosition
from rayfix_tables.site import SiteInfo

UNKNOWN_PROVIDER = "unknown"
"""Provider type of all locations, and provider id of a fix without a target, because a location must have one."""


def fix_to_omlox(fix: Fix, site: SiteInfo, track: TrackedPosition | None = None) -> dict[str, Any]:
    """Describe the best candidate of a fix as an omlox Location.

    The position is in the scene frame, so ``crs`` is "local", and ``source``, the site's name, should be the foreign id
    of the hub's zone. Values for which the format has no field are in ``properties``. With a track, the position is
    that of the track, with ``speed`` and ``course``, the horizontal velocity and its bearing.

    Raises
    ------
    ReportError
        When the fix has no position.
    """
    candidate, regions = best_candidate(fix, track)
    location: dict[str, Any] = {
        "position": {"type": "Point", "coordinates": candidate.position.tolist()},
        "source": site.name,
        "provider_type": UNKNOWN_PROVIDER,
        "provider_id": fix.target_id or UNKNOWN_PROVIDER,
        "crs": "local",
        "accuracy": regions.horizontal_radius(fix.confidence),
        "elevation_ref": "floor",
        "floor": 0,
        "properties": {
            "rayfix.status": fix.status,
            "rayfix.probability": float(candidate.probability),
            "rayfix.vertical_accuracy_m": regions.vertical_half_height(fix.confidence),
            "rayfix.covariance_m2": candidate.covariance.tolist(),
            "rayfix.table_id": fix.table_id,
        },
    }
    if fix.warnings:
        location["properties"]["rayfix.warnings"] = list(fix.warnings)
    timestamp = fix.timestamp if track is None else track.timestamp
    if timestamp is not None:
        location["timestamp_generated"] = utc_milliseconds(timestamp)
    if track is not None:
        vx, vy, _ = track.estimate.velocity.tolist()
        location["speed"] = math.hypot(vx, vy)
        location["course"] = math.degrees(site.north - math.atan2(vy, vx)) % 360.0
        location["properties"]["rayfix.track"] = track.state
    return location
