"""Biases that depend on the direction, and deviations that a calibration found."""

import numpy as np
import pytest

from rayfix_service.fusion.measurements.calibrated import local_bias, with_deviations
from rayfix_service.fusion.measurements.directions import without_bias
from rayfix_service.fusion.measurements.report import Angle, ErrorModel, Range, Report, TimeDifference
from rayfix_tables.site import AngleBias, Deviations, SiteInfo, Station, StationBias

AZIMUTHS = tuple(np.deg2rad(np.arange(-60.0, 61.0, 10.0)).tolist())
ZENITHS = tuple(np.deg2rad([60.0, 90.0, 120.0]).tolist())


def gain(slope: float) -> AngleBias:
    """Bias of an azimuth that is measured too small, and a zenith that is 2 deg too large."""
    row = tuple((slope - 1.0) * a for a in AZIMUTHS)
    flat = (0.0,) * len(AZIMUTHS)
    up = (float(np.deg2rad(2.0)),) * len(AZIMUTHS)
    known = (0.01,) * len(AZIMUTHS)
    return AngleBias(
        azimuths=AZIMUTHS,
        zeniths=ZENITHS,
        azimuth=(row,) * 3,
        zenith=(up,) * 3,
        azimuth_stdev=(known,) * 3,
        zenith_stdev=(flat,) * 3,
    )


@pytest.mark.parametrize("slope", [0.6, 0.8, 1.0, 1.3])
@pytest.mark.parametrize("true_deg", [-55.0, -3.0, 0.0, 12.5, 48.0])
def test_the_true_direction_is_solved_for(slope: float, true_deg: float) -> None:
    station = Station(id="a", position=(0.0, 0.0, 0.0), bias=StationBias(angles=gain(slope), zenith=0.01))
    measured = Angle(
        station_id="a",
        azimuth=slope * np.deg2rad(true_deg),
        azimuth_stdev=0.05,
        zenith=np.deg2rad(80.0) + np.deg2rad(2.0) + 0.01,
        zenith_stdev=0.03,
    )
    found = without_bias(measured, station)
    assert np.rad2deg(found.azimuth) == pytest.approx(true_deg, abs=1e-4)
    assert found.zenith is not None
    assert np.rad2deg(found.zenith) == pytest.approx(80.0, abs=1e-4)
    # A degree more of the true azimuth is `slope` degrees more of the measured one.
    assert found.azimuth_stdev == pytest.approx(np.hypot(0.05, 0.01) / slope, rel=1e-6)
    assert found.zenith_stdev == pytest.approx(0.03, rel=1e-9)


def test_beyond_the_grid_the_edge_holds_and_azimuths_wrap() -> None:
    bias = gain(0.8)
    edge = local_bias(bias, np.deg2rad(60.0 * 0.8), np.deg2rad(90.0))
    far = local_bias(bias, np.deg2rad(100.0), np.deg2rad(90.0))
    assert far.azimuth == pytest.approx(edge.azimuth, abs=1e-4)
    assert far.azimuth_slope == 1.0
    turned = local_bias(bias, np.deg2rad(12.0 - 360.0), np.deg2rad(90.0))
    assert turned.azimuth == pytest.approx(local_bias(bias, np.deg2rad(12.0), np.deg2rad(90.0)).azimuth, abs=1e-9)


def test_deviations_replace_those_that_are_stated() -> None:
    found = Deviations(azimuth=0.1, zenith=0.2, range=0.3, tail_share=0.1, tail_scale=4.0)
    site = SiteInfo(
        name="s",
        north=0.0,
        max_path_length=10.0,
        stations=(
            Station(id="a", position=(0.0, 0.0, 0.0), deviations=found),
            Station(id="b", position=(1.0, 0.0, 0.0)),
        ),
    )
    azimuth = Angle(station_id="a", azimuth=0.0, azimuth_stdev=0.5)
    length = Range(station_id="a", path_length=1.0, stdev=2.0)
    other = Range(station_id="b", path_length=1.0, stdev=2.0)
    difference = TimeDifference(station_id="a", reference_station_id="b", length_difference=0.1, stdev=0.5)
    report = with_deviations(Report(measurements=(azimuth, length, other, difference)), site)
    one, two, three, four = report.measurements
    errors = ErrorModel(tail_share=0.1, tail_scale=4.0)
    assert one == Angle(station_id="a", azimuth=0.0, azimuth_stdev=0.1, error_model=errors)
    assert two == Range(station_id="a", path_length=1.0, stdev=0.3, error_model=errors)
    assert (three, four) == (other, difference)
