"""What of a report the paper's method takes."""

import numpy as np
import pytest

from rayfix_evaluation.paper.reports import sort_for_paper
from rayfix_service.fusion.measurements.report import (
    HEAVY_TAILED,
    Angle,
    Height,
    LogRange,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station, StationBias

BIAS = StationBias(range=0.2, range_stdev=0.3, azimuth=0.01, angle_stdev=0.02)
SITE = SiteInfo(
    name="three",
    north=0.0,
    max_path_length=50.0,
    stations=(
        Station(id="a", position=(0.0, 0.0, 2.0)),
        Station(id="b", position=(5.0, 0.0, 2.0), bias=BIAS),
        Station(id="c", position=(5.0, 5.0, 2.0)),
    ),
)
ANGLE = Angle(station_id="b", azimuth=0.5, zenith=1.5, azimuth_stdev=0.02, zenith_stdev=0.03)


def difference(station: str, reference: str) -> TimeDifference:
    return TimeDifference(station_id=station, reference_station_id=reference, length_difference=1.0, stdev=0.4)


def test_biases_are_taken_off_and_their_doubt_added() -> None:
    measurements = (
        ANGLE,
        Range(station_id="b", path_length=7.0, stdev=0.4),
        difference("b", "a"),
        difference("c", "a"),
    )
    found = sort_for_paper(Report(measurements=measurements), SITE)
    assert found.names == ["b", "a", "c"]
    assert found.reference == "a"
    assert found.directions["b"].azimuth == pytest.approx(0.49, abs=1e-12)
    assert found.directions["b"].cov[0, 0] == pytest.approx(0.02**2 + 0.02**2, rel=1e-12)
    np.testing.assert_allclose(found.ranges["b"], (6.8, 0.5), rtol=0, atol=1e-12)
    own, plain = found.differences["b"], found.differences["c"]
    np.testing.assert_allclose((own.length_difference, own.stdev), (0.8, 0.5), rtol=0, atol=1e-12)
    np.testing.assert_allclose((plain.length_difference, plain.stdev), (1.0, 0.4), rtol=0, atol=1e-12)


def test_a_biased_reference_biases_its_differences() -> None:
    found = sort_for_paper(Report(measurements=(difference("a", "b"),)), SITE)
    assert found.differences["a"].length_difference == pytest.approx(1.2, abs=1e-12)


def test_arrivals_become_differences_to_the_first() -> None:
    arrivals = tuple(
        TimeOfArrival(station_id=name, path_length=length, stdev=stdev)
        for name, length, stdev in [("c", 107.0, 0.3), ("a", 104.0, 0.4)]
    )
    found = sort_for_paper(Report(measurements=arrivals), SITE)
    assert (found.reference, list(found.differences)) == ("c", ["a"])
    assert found.differences["a"].length_difference == pytest.approx(-3.0, abs=1e-12)
    assert found.differences["a"].stdev == pytest.approx(0.5, abs=1e-12)
    assert found.ranges == {}


@pytest.mark.parametrize(
    ("measurements", "message"),
    [
        ((LogRange(station_id="a", path_length=3.0, log_stdev=0.4),), "Gaussian errors only"),
        ((Range(station_id="a", path_length=3.0, stdev=0.4, error_model=HEAVY_TAILED),), "Gaussian errors only"),
        ((ANGLE, ANGLE), "'b' has two"),
        ((Angle(station_id="a", azimuth=0.5, azimuth_stdev=0.02),), "leave the lone azimuth out"),
        ((difference("b", "a"), difference("c", "b")), "to one reference, not to a, b"),
        ((Range(station_id="z", path_length=3.0, stdev=0.4),), "station 'z' is not in the site; it has a, b, c"),
        ((difference("b", "z"),), "station 'z' is not in the site"),
    ],
)
def test_what_the_method_does_not_know_is_refused(measurements: tuple[Measurement, ...], message: str) -> None:
    with pytest.raises(ReportError, match=message):
        sort_for_paper(Report(measurements=measurements), SITE)


def test_a_height_is_refused() -> None:
    report = Report(measurements=(ANGLE,), height=Height(z=1.0, stdev=0.1))
    with pytest.raises(ReportError, match="does not support a height"):
        sort_for_paper(report, SITE)
