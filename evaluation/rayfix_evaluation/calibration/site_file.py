"""A calibrated site as a site file."""

import copy
from typing import Any

import numpy as np

from rayfix_evaluation.calibration.station import StationCalibration
from rayfix_tables.site import AngleBias, SiteInfo, Station

__all__ = ["calibrated_document"]

_TURNS = ("boresight_azimuth_deg", "boresight_downtilt_deg", "roll_deg", "orientation_deg")


def calibrated_document(site: SiteInfo, found: dict[str, StationCalibration]) -> dict[str, Any]:
    """Write a site's document with what was found of its stations.

    Parameters
    ----------
    site : SiteInfo
        As it was; its document is that of the site file.
    found : dict of StationCalibration
        By station.
    """
    document = copy.deepcopy(site.document)
    for section in document["stations"]:
        each = found.get(section["id"])
        if each is not None:
            _write_station(section, site.station_by_id[section["id"]], each)
    return document


def _write_station(section: dict[str, Any], before: Station, found: StationCalibration) -> None:
    station = found.station
    if station.orientation != before.orientation:
        for key in _TURNS:
            section.pop(key, None)
        section["orientation_deg"] = [_rounded(v) for v in np.rad2deg(station.orientation)]
    bias = station.bias
    if bias != before.bias:
        section["bias"] = {
            "range_m": _rounded(bias.range),
            "range_stdev_m": _rounded(bias.range_stdev),
            "azimuth_deg": _rounded(np.rad2deg(bias.azimuth)),
            "zenith_deg": _rounded(np.rad2deg(bias.zenith)),
            "angle_stdev_deg": _rounded(np.rad2deg(bias.angle_stdev)),
        }
        if bias.angles is not None:
            section["bias"]["angles"] = _grid(bias.angles)
    deviations = station.deviations
    if deviations is None:
        return
    values = {
        "azimuth_deg": None if deviations.azimuth is None else np.rad2deg(deviations.azimuth),
        "zenith_deg": None if deviations.zenith is None else np.rad2deg(deviations.zenith),
        "range_m": deviations.range,
        "tail_share": deviations.tail_share,
        "tail_scale": deviations.tail_scale,
    }
    part = found.angles or found.ranges
    if part is not None and part.correlation_time is not None:
        values |= {"correlation_s": part.correlation_time, "correlated_share": part.correlated_share}
    section["deviations"] = {key: _rounded(value) for key, value in values.items() if value is not None}


def _grid(angles: AngleBias) -> dict[str, Any]:
    axes = {
        f"{name}_deg": [_rounded(v, 4) for v in np.rad2deg(getattr(angles, name))] for name in ("azimuths", "zeniths")
    }
    rows = {
        f"{name}_deg": [[_rounded(v, 3) for v in row] for row in np.rad2deg(getattr(angles, name))]
        for name in ("azimuth", "zenith", "azimuth_stdev", "zenith_stdev")
    }
    return axes | rows


def _rounded(value: Any, digits: int = 5) -> float:
    return round(float(value), digits)
