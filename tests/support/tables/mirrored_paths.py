"""Measured paths in the mirrored room: the direct one of a station, and the one by its wall."""

import math

import numpy as np
from numpy.typing import NDArray

from tests.support.tables.open_room import POSITIONS

AT = np.array([3.0, 4.0, 1.2])


def seen(name: str, clock: str, offset: float = 0.0, place: NDArray[np.float64] = AT) -> list[dict[str, object]]:
    """Return the direct path from a station of the mirrored room, and the one by its wall, without noise."""
    rows: list[dict[str, object]] = []
    x, y, z = POSITIONS[name]
    lengths = []
    for image, turn in ((np.array([x, y, z]), 1.0), (np.array([12.0 - x, y, z]), -1.0)):
        apart = place - image
        length = float(np.linalg.norm(apart))
        lengths.append(length)
        a, b, c = apart * np.array([turn, 1.0, 1.0]) / length
        row: dict[str, object] = {"type": "path", "station_id": name, "azimuth_stdev_deg": 1.0, "zenith_stdev_deg": 1.0}
        row |= {"azimuth_deg": math.degrees(math.atan2(b, a)), "zenith_deg": math.degrees(math.acos(c))}
        if clock == "delay_ns":
            row |= {"delay_ns": (length - lengths[0]) / 0.299792458, "stdev_ns": 0.3}
        else:
            row |= {clock: length + offset, "stdev_m": 0.1}
        rows.append(row)
    return rows
