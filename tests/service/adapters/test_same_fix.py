"""One measurement in every format gives one fix, on the small table of the hall.

The target at (7.0, 4.0, 1.5) m is in sight of bs1, bs2 and bs3. North is the scene's +y axis, the stations are
turned by 45, 135 and -135 deg.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.adapters.formats import InputFormat, parse, write
from rayfix_service.adapters.ublox import AngleErrors
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

TARGET = np.array([7.0, 4.0, 1.5])  # m
NORTH_DEG = 90
BEARING_DEG = {"bs1": 45, "bs2": 135, "bs3": -135}
TC_M = 299_792_458 / (480_000 * 4096)
CLOCK_M = 4000.0  # what the UE's unknown time of transmission adds to all arrivals


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    return Locator(Table.open(hall_table_path))


@pytest.fixture(scope="module")
def sight(locator: Locator) -> dict[str, tuple[float, float, float]]:
    """Azimuth and zenith, deg, and distance, m, of the target at each station, and some noise."""
    rng = np.random.default_rng(8)
    found = {}
    for station in locator.table.site.stations:
        if station.id in BEARING_DEG:
            x, y, z = TARGET - station.position
            distance = math.sqrt(x * x + y * y + z * z)
            azimuth, zenith = math.degrees(math.atan2(y, x)), math.degrees(math.acos(z / distance))
            noise = rng.normal(size=3) * [1.0, 1.0, 0.5]
            found[station.id] = (azimuth + noise[0], zenith + noise[1], distance + noise[2])
    return found


def locate(locator: Locator, document: Any, input_format: InputFormat) -> Fix:
    body = document if isinstance(document, str) else json.dumps(document)
    (adapted,) = parse(body.encode(), input_format, errors=AngleErrors(stdev_deg=5.0, tail_share=0.0, tail_scale=1.0))
    fix = locator.locate(adapted.report)
    assert fix.status in ("ok", "ambiguous")
    assert all(outcome.used for outcome in fix.outcomes)
    assert json.loads(json.dumps(write(fix, "native", locator.table.site, compute_seconds=0.0, adapted=adapted)))
    return fix


def aoa(station_id: str, azimuth: float, zenith: float, stdev: float) -> dict[str, Any]:
    """Write an angle in the native format and the scene frame."""
    return {
        "type": "aoa",
        "station_id": station_id,
        "azimuth_deg": (azimuth + 180) % 360 - 180,
        "zenith_deg": zenith,
        "azimuth_stdev_deg": stdev,
        "zenith_stdev_deg": stdev,
    }


def position(fix: Fix) -> NDArray[np.float64]:
    assert fix.position is not None
    return fix.position


def assert_same(fix: Fix, native: Fix) -> None:
    """Expect the same fix but for rounding: 1e-6 m is what turning angles back and forth may move it."""
    assert position(fix) == pytest.approx(position(native), abs=1e-6)
    assert fix.candidates[0].covariance == pytest.approx(native.candidates[0].covariance, rel=1e-5, abs=1e-9)
    assert fix.status == native.status
    assert len(fix.candidates) == len(native.candidates)


LineOfSightWeights = dict[str, tuple[float, float, float]]


def test_nrppa(locator: Locator, sight: LineOfSightWeights):
    trps, decoded, exact = [], [], []
    for trp_id, (station_id, (azimuth, zenith, distance)) in enumerate(sight.items(), 1):
        azimuth_value = math.floor((azimuth - NORTH_DEG) % 360 * 10)
        zenith_value = math.floor(zenith * 10)
        time_value = math.floor(((distance + CLOCK_M) / TC_M + 985024) / 2) + 1
        quality = {"azimuthQuality": 10, "zenithQuality": 10, "resolution": "deg0dot1"}
        trps.append(
            {
                "tRP-ID": trp_id,
                "measurementResult": [
                    {
                        "measuredResultsValue": {
                            "uL-AngleOfArrival": {"azimuthAoA": azimuth_value, "zenithAoA": zenith_value}
                        },
                        "measurementQuality": {"angleMeasQuality": quality},
                    },
                    {
                        "measuredResultsValue": {"uL-RTOA": {"uLRTOAmeas": {"k1": time_value}}},
                        "measurementQuality": {"timingMeasQuality": {"measurementQuality": 5, "resolution": "m0dot1"}},
                    },
                ],
            }
        )
        stdev, time_stdev = math.sqrt(1 + 0.01 / 12), math.sqrt(0.25 + (2 * TC_M) ** 2 / 12)
        decoded += [
            aoa(station_id, azimuth_value / 10 + 0.05 + NORTH_DEG, zenith_value / 10 + 0.05, stdev),
            {
                "type": "toa",
                "station_id": station_id,
                "range_m": (-985024 + (time_value - 0.5) * 2) * TC_M,
                "stdev_m": time_stdev,
            },
        ]
        exact += [
            aoa(station_id, azimuth, zenith, 1.0),
            {"type": "toa", "station_id": station_id, "range_m": distance, "stdev_m": 0.5},
        ]
    stations = {str(n): station_id for n, station_id in enumerate(sight, 1)}
    fix = locate(locator, {"TRP-MeasurementResponseList": trps, "stations": stations}, "nrppa")
    assert_same(fix, locate(locator, {"measurements": decoded}, "native"))
    # Half of 0.1 deg at 9 m is 8 mm, half of 2 Tc 15 cm, which counts little beside the angles.
    unrounded = position(locate(locator, {"measurements": exact}, "native"))
    assert np.linalg.norm(position(fix) - unrounded) < 0.05


def test_silabs(locator: Locator, sight: LineOfSightWeights):
    angles, native = [], []
    for station_id, (azimuth, zenith, distance) in sight.items():
        angles.append(
            {
                "locator_id": f"ble-{station_id}",
                "azimuth": (BEARING_DEG[station_id] - azimuth + 180) % 360 - 180,
                "azimuth_stdev": 1.0,
                "elevation": 90 - zenith,
                "elevation_stdev": 1.0,
                "distance": distance,
                "distance_stdev": 0.5,
                "sequence": 12,
            }
        )
        native += [
            aoa(station_id, azimuth, zenith, 1.0),
            {"type": "pt", "station_id": station_id, "range_m": distance, "stdev_m": 0.5},
        ]
    document = {"angles": angles, "stations": {f"ble-{station_id}": station_id for station_id in sight}}
    assert_same(locate(locator, document, "silabs"), locate(locator, {"measurements": native}, "native"))


def test_ublox(locator: Locator, sight: LineOfSightWeights):
    lines, decoded = [], []
    for station_id, (azimuth, zenith, _) in sight.items():
        right, up = round(BEARING_DEG[station_id] - azimuth), round(90 - zenith)
        lines.append(f'+UUDF:6C1DEBA5F60C,-53,{right},{up},0,37,"{station_id}","",1437347,7')
        decoded.append(aoa(station_id, BEARING_DEG[station_id] - right, 90 - up, 5.0))
    fix = locate(locator, "\r\n".join(lines), "ublox")
    assert_same(fix, locate(locator, {"measurements": decoded}, "native"))
    # Half a degree at 9 m is 8 cm.
    exact = [aoa(station_id, azimuth, zenith, 5.0) for station_id, (azimuth, zenith, _) in sight.items()]
    assert np.linalg.norm(position(fix) - position(locate(locator, {"measurements": exact}, "native"))) < 0.15


def test_the_fix_is_near_the_target(locator: Locator, sight: LineOfSightWeights):
    """So that a mistake that all formats share would show: 1 deg at 9 m is 16 cm, three stations.

    With this noise, a place a metre away by way of a reflection is about as probable.
    """
    native = [aoa(station_id, azimuth, zenith, 1.0) for station_id, (azimuth, zenith, _) in sight.items()]
    fix = locate(locator, {"measurements": native}, "native")
    near = [c.probability for c in fix.candidates if np.linalg.norm(c.position - TARGET) < 0.4]
    assert sum(near) > 0.3
