"""A station as JSON: what a calibration has found of it."""

import math

import pytest

from rayfix_service.wire.table import station_summary
from rayfix_tables.site import AngleBias, Deviations, Station, StationBias


def test_a_station_without_a_calibration_says_so() -> None:
    assert station_summary(Station(id="a", position=(1.0, 2.0, 3.0)), ()).calibration is None


def test_a_calibration_is_in_degrees_and_metres() -> None:
    grid = AngleBias(
        azimuths=(-1.0, 1.0),
        zeniths=(1.5,),
        azimuth=((0.01, -0.02),),
        zenith=((0.0, 0.03),),
        azimuth_stdev=((0.0, 0.0),),
        zenith_stdev=((0.0, 0.0),),
    )
    bias = StationBias(range=0.4, azimuth=0.05, zenith=-0.02, angles=grid)
    station = Station(id="a", position=(1.0, 2.0, 3.0), bias=bias, deviations=Deviations(azimuth=0.07))
    found = station_summary(station, ()).calibration
    assert found is not None
    assert (found.range_m, found.range_stdev_m, found.zenith_stdev_deg) == (0.4, None, None)
    assert found.azimuth_deg == pytest.approx(math.degrees(0.05))
    assert found.azimuth_stdev_deg == pytest.approx(math.degrees(0.07))
    assert found.angles is not None
    assert found.angles.azimuths_deg == pytest.approx([math.degrees(-1.0), math.degrees(1.0)])
    assert found.angles.azimuth_deg[0] == pytest.approx([math.degrees(0.01), math.degrees(-0.02)])
    assert found.angles.zenith_deg[0] == pytest.approx([0.0, math.degrees(0.03)])
