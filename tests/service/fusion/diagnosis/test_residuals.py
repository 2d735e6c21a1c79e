"""Residuals against the straight path: a station at (1, 2, 3), and a position two metres along each axis from it."""

import math

import numpy as np
import pytest

from rayfix_service.fusion.diagnosis.residuals import angle_residual, range_residual
from rayfix_service.fusion.measurements.directions import to_scene
from rayfix_service.fusion.measurements.report import Angle, Range
from rayfix_tables.geometry.angles import angles_of, direction, local_to_scene
from rayfix_tables.site import Station, StationBias

NORTH = 0.4
POSITION = (3.0, 4.0, 5.0)
STATION = Station(id="a", position=(1.0, 2.0, 3.0), orientation=(0.7, 0.3, -0.2))
ZENITH = math.acos(1 / math.sqrt(3))


def angle(azimuth: float, zenith: float | None = None, frame: str = "scene") -> Angle:
    stdev = None if zenith is None else 0.1
    return Angle(
        station_id="a",
        azimuth=azimuth,
        azimuth_stdev=0.1,
        zenith=zenith,
        zenith_stdev=stdev,
        frame=frame,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("error", [0.0, 1e-6, 0.05, 1.5])
def test_an_error_of_the_zenith_is_the_residual(error: float):
    found = angle_residual(angle(math.pi / 4, ZENITH + error), STATION, NORTH, POSITION)
    assert found == pytest.approx(error, rel=1e-6, abs=1e-12)


def test_an_error_of_the_azimuth_counts_less_at_a_slope():
    found = angle_residual(angle(math.pi / 4 + 1e-3, ZENITH), STATION, NORTH, POSITION)
    assert found == pytest.approx(1e-3 * math.sqrt(2 / 3), rel=1e-3)


@pytest.mark.parametrize("frame", ["scene", "north", "lcs"])
def test_frames_are_those_of_the_fusion(frame: str):
    """The residual is the angle to the direction that the fusion takes the measurement for."""
    measured = angle(0.9, 1.2, frame)
    meant = to_scene(measured, STATION, NORTH)
    assert meant.azimuth is not None
    assert meant.zenith is not None
    cosine = float(direction(meant.azimuth, meant.zenith) @ np.ones(3)) / math.sqrt(3)
    assert angle_residual(measured, STATION, NORTH, POSITION) == pytest.approx(math.acos(cosine), abs=1e-9)


def test_azimuths_alone():
    assert angle_residual(angle(math.pi / 4 + 0.2), STATION, NORTH, POSITION) == pytest.approx(0.2)
    assert angle_residual(angle(math.pi / 4 - 0.2 + 6 * math.pi), STATION, NORTH, POSITION) == pytest.approx(0.2)
    azimuth, _ = angles_of(local_to_scene(STATION.orientation).T @ np.ones(3))
    assert angle_residual(angle(float(azimuth) + 0.3, frame="lcs"), STATION, NORTH, POSITION) == pytest.approx(0.3)


def test_the_bias_is_taken_off():
    station = Station(id="a", position=(1.0, 2.0, 3.0), bias=StationBias(range=0.5, zenith=0.1))
    assert angle_residual(angle(math.pi / 4, ZENITH + 0.1), station, NORTH, POSITION) == pytest.approx(0.0, abs=1e-9)
    measured = Range(station_id="a", path_length=math.sqrt(12) + 0.5 - 2.0, stdev=0.1)
    assert range_residual(measured, station, POSITION) == pytest.approx(2.0)


def test_there_is_no_direction_to_the_station_itself():
    assert angle_residual(angle(0.0, 1.0), STATION, NORTH, STATION.position) is None
    assert angle_residual(angle(0.0), STATION, NORTH, (1.0, 2.0, 9.0)) is None
