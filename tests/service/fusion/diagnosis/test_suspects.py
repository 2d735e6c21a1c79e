"""What an inconsistent fix says of its measurements."""

from rayfix_service.fusion.diagnosis.suspects import named, suspects
from rayfix_service.fusion.measurements.report import Angle, LogRange, Range, Report, TimeDifference, TimeOfArrival
from rayfix_service.fusion.posterior.fix import Fix, Outcome

MEASUREMENTS = (
    Angle(station_id="a", azimuth=0.1, azimuth_stdev=0.1),
    Range(station_id="b", path_length=5.0, stdev=0.5),
    LogRange(station_id="c", path_length=5.0, log_stdev=0.5),
    TimeOfArrival(station_id="d", path_length=5.0, stdev=0.5),
    TimeDifference(station_id="e", reference_station_id="f", length_difference=5.0, stdev=0.5),
)


def said(*probabilities: float | None, repeat: int = 1) -> str:
    outcomes = tuple(Outcome(used=p is not None, outlier_probability=p) for p in probabilities) * repeat
    fix = Fix(status="inconsistent", candidates=(), outcomes=outcomes, log_evidence=0.0, table_id="t")
    return suspects(Report(measurements=MEASUREMENTS[: len(probabilities)] * repeat), fix)


def test_each_kind_has_a_name() -> None:
    assert [named(measurement) for measurement in MEASUREMENTS] == [
        "the angle of station 'a'",
        "the propagation time of station 'b'",
        "the signal strength of station 'c'",
        "the time of arrival of station 'd'",
        "the time difference of station 'e' to 'f'",
    ]


def test_the_suspects_are_named_with_their_station() -> None:
    text = said(0.9, 0.2, None, 0.7)
    assert "the angle of station 'a' (measurements[0]) and the time of arrival of station 'd' (measurements[3])" in text
    assert "station 'b'" not in text
    assert "station 'c'" not in text
    assert "cannot be trusted" in text


def test_many_suspects_are_counted() -> None:
    assert "measurements[5]) and 4 more;" in said(0.9, 0.9, 0.9, 0.9, 0.9, repeat=2)


def test_rivals_that_blame_different_measurements() -> None:
    assert "which of them are outliers is open" in said(0.4, 0.45)
