"""What a calibration found of a station, as a text of the table file."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import Any

from rayfix_tables.site import AngleBias, Deviations, Station

CALIBRATION = "calibration"
"""Attribute of a station's group; a station without a calibration has none."""


def calibration_text(station: Station) -> str | None:
    """Write the calibration of a station, in rad and m; None where there is none."""
    if station.bias.angles is None and station.deviations is None:
        return None
    return json.dumps(
        {
            "angles": None if station.bias.angles is None else asdict(station.bias.angles),
            "deviations": None if station.deviations is None else asdict(station.deviations),
        },
        sort_keys=True,
    )


def read_calibration(attributes: Mapping[str, Any]) -> tuple[AngleBias | None, Deviations | None]:
    """Read the calibration of a station from the attributes of its group.

    Raises
    ------
    ValueError
        When it is damaged.
    """
    text = attributes.get(CALIBRATION)
    if text is None:
        return None, None
    try:
        document = json.loads(text)
        angles, deviations = document["angles"], document["deviations"]
        found = None if angles is None else _angle_bias(angles)
        return found, None if deviations is None else _deviations(deviations)
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError("the calibration of a station is damaged") from error


def _angle_bias(document: Mapping[str, Any]) -> AngleBias:
    axes = {name: tuple(_number(v) for v in document[name]) for name in ("azimuths", "zeniths")}
    shape = len(axes["zeniths"]), len(axes["azimuths"])
    rows = {
        name: tuple(tuple(_number(v) for v in row) for row in document[name])
        for name in ("azimuth", "zenith", "azimuth_stdev", "zenith_stdev")
    }
    whole = all((len(found), *{len(row) for row in found}) == shape for found in rows.values())
    ascending = all(a < b for axis in axes.values() for a, b in pairwise(axis))
    if not whole or not ascending or min(shape) < 1:
        raise ValueError("the biases of a station's angles are no grid")
    return AngleBias(
        azimuths=axes["azimuths"],
        zeniths=axes["zeniths"],
        azimuth=rows["azimuth"],
        zenith=rows["zenith"],
        azimuth_stdev=rows["azimuth_stdev"],
        zenith_stdev=rows["zenith_stdev"],
    )


def _deviations(document: Mapping[str, Any]) -> Deviations:
    azimuth, zenith, length = (
        None if document[name] is None else _number(document[name]) for name in ("azimuth", "zenith", "range")
    )
    # Tables of earlier versions do not have these two.
    time, share = (
        None if document.get(name) is None else _number(document[name])
        for name in ("correlation_time", "correlated_share")
    )
    if (time is not None and time <= 0.0) or (share is not None and not 0.0 <= share <= 1.0):
        raise ValueError("the drift of a station's errors is out of range")
    return Deviations(
        azimuth=azimuth,
        zenith=zenith,
        range=length,
        tail_share=_number(document["tail_share"]),
        tail_scale=_number(document["tail_scale"]),
        correlation_time=time,
        correlated_share=share,
    )


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError("the calibration of a station has something that is no number")
    return float(value)
