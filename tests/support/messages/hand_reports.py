"""Reports of what the stations of :mod:`tests.support.tables.hand_tables` hear."""

from collections.abc import Sequence

import numpy as np

from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, Report, TimeDifference, TimeOfArrival
from rayfix_service.fusion.settings import FusionSettings
from tests.support.tables.hand_tables import GRID, POSITIONS, Tube, line_of_sight

TUBES = [line_of_sight("a"), line_of_sight("b", log_mass=0.3), line_of_sight("c", log_mass=-0.5)]
EXACT = FusionSettings(unmodelled_probability=0.0, component_floor=1e-30, hypothesis_floor=1e-30, max_divergence=0.0)
"""Settings with which the fusion leaves out and merges nothing."""


def angle_of(tube: Tube, stdev: tuple[float, float] = (0.02, 0.03)) -> Angle:
    """Angle towards a place between a tube's middle and the centre of its cell, with these deviations, rad."""
    azimuth, zenith = GRID.centres[tube.cell]
    return Angle(
        station_id=tube.station_id,
        azimuth=float(azimuth + 0.4 * tube.u_mean[1] / np.sin(zenith)),
        zenith=float(zenith + 0.6 * tube.u_mean[2]),
        azimuth_stdev=stdev[0],
        zenith_stdev=stdev[1],
    )


def report_of(measurements: Sequence[Measurement]) -> Report:
    return Report(measurements=tuple(measurements))


def measured(kind: str, outlier: str = "") -> list[Measurement]:
    """Measurements of all stations with errors of about a deviation; the times of one of them may be 6 m late."""
    angles: list[Measurement] = [angle_of(tube) for tube in TUBES]
    errors = {"a": 0.3, "b": -0.2, "c": 0.4}
    times: list[Measurement] = []
    for tube in TUBES:
        name = tube.station_id
        length = float(np.linalg.norm(tube.x_mean - np.array(POSITIONS[name]))) + (6.0 if name == outlier else 0.0)
        if "pt" in kind:
            times.append(Range(station_id=name, path_length=length + errors[name], stdev=0.4))
        if "toa" in kind:
            times.append(TimeOfArrival(station_id=name, path_length=length + 123.0 - errors[name], stdev=0.3))
    return angles + times


def differences(reference: str, outlier: str = "") -> list[Measurement]:
    """Angles, and the time differences that the times of arrival of :func:`measured` make."""
    measurements = measured("aoa+toa", outlier)
    arrivals = [m for m in measurements if isinstance(m, TimeOfArrival)]
    (at_reference,) = [m for m in arrivals if m.station_id == reference]
    made = [
        TimeDifference(
            station_id=m.station_id,
            reference_station_id=reference,
            length_difference=m.path_length - at_reference.path_length,
            stdev=float(np.sqrt(2.0)) * m.stdev,
        )
        for m in arrivals
        if m is not at_reference
    ]
    return [*(m for m in measurements if isinstance(m, Angle)), *made]
