"""What is written of a report is read as that report again, or refused where it is written."""

import json
import math
from dataclasses import fields, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_service.adapters.nrppa import parse_nrppa
from rayfix_service.adapters.silabs import parse_silabs
from rayfix_service.fusion.measurements.report import (
    GAUSSIAN,
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Height,
    LogRange,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.http.openapi.examples import NRPPA_EXAMPLES, SILABS_EXAMPLES
from rayfix_service.wire import METRES_PER_NANOSECOND, InvalidReportError, parse_report, report_to_document

C = METRES_PER_NANOSECOND


def number(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers between two limits, the limits themselves and those beside them often."""
    edges = [low, high, math.nextafter(low, high), math.nextafter(high, low)]
    return st.floats(low, high) | st.sampled_from(edges)


STATIONS = st.sampled_from(["bs1", "bs2", "b" * 128, "\n", "ü/+#"])
STDEVS_M, STDEVS_NS = number(1e-6, 1e6), number(1e-6, 1e6)
STDEVS_DEG = number(1e-6, 360.0)
NOTHING = st.just({})
TAILS = NOTHING | st.fixed_dictionaries(
    {"error_model": st.just("heavy_tailed")},
    optional={"tail_share": number(1e-3, 0.5), "tail_scale": number(1.5, 20.0)},
)
SIGHTS = NOTHING | st.fixed_dictionaries({"los_probability": number(0.0, 1.0)})


def document(kind: str, *forms: dict[str, st.SearchStrategy[Any]], more: Any = NOTHING) -> Any:
    """Documents of one kind of measurement in any of its forms."""
    one = st.one_of(*(st.fixed_dictionaries(form) for form in forms))
    return st.builds(
        lambda station, form, tails, rest: {"type": kind, "station_id": station, **form, **tails, **rest},
        STATIONS,
        one,
        TAILS,
        more,
    )


def in_one_turn(form: dict[str, float]) -> bool:
    """Whether times are of one path of at most 1000 km."""
    if "round_trip_ns" in form:
        return abs(0.5 * C * (form["round_trip_ns"] - form["reply_ns"])) <= 1e6
    return "toa_ns" not in form or abs(C * (form["toa_ns"] - form["tod_ns"])) <= 1e6


def strength_of(measured: LogRange, exponent: float) -> dict[str, float]:
    """Write a distance as a signal strength by a model of this exponent."""
    scale = 10.0 * exponent / math.log(10.0)
    loss = scale * math.log(measured.path_length)
    return {
        "rssi_dbm": -50.0 - loss / 2,
        "power_at_1m_dbm": -50.0 + loss / 2,
        "path_loss_exponent": exponent,
        "shadowing_stdev_db": scale * measured.log_stdev,
    }


def is_read(document: dict[str, Any]) -> bool:
    """Whether a document is a valid report."""
    try:
        parse_report(document)
    except InvalidReportError:
        return False
    return True


ANGLES = document(
    "aoa",
    {"azimuth_deg": number(-180.0, 360.0), "azimuth_stdev_deg": STDEVS_DEG},
    {
        "azimuth_deg": number(-180.0, 360.0),
        "azimuth_stdev_deg": STDEVS_DEG,
        "zenith_deg": number(0.0, 180.0),
        "zenith_stdev_deg": STDEVS_DEG,
        "correlation": number(-0.999, 0.999),
        "frame": st.sampled_from(["scene", "lcs", "north"]),
    },
    more=SIGHTS,
)
RANGES = document(
    "pt",
    {"range_m": number(-1e6, 1e6), "stdev_m": STDEVS_M},
    {"delay_ns": number(-1e6, 1e6), "stdev_ns": STDEVS_NS},
    {"toa_ns": number(-1e6, 1e6), "tod_ns": number(-1e6, 1e6), "stdev_ns": STDEVS_NS},
    {"round_trip_ns": number(-6e6, 6e6), "reply_ns": number(0.0, 6e5), "stdev_ns": STDEVS_NS},
    {"round_trip_ns": number(2e6 / C - 1e-3, 2e6 / C), "reply_ns": st.just(0.0), "stdev_ns": st.just(1e-6)},
    more=SIGHTS,
).filter(in_one_turn)
ARRIVALS = document(
    "toa",
    {"range_m": number(-1e12, 1e12), "stdev_m": STDEVS_M},
    {"delay_ns": number(-1e12, 1e12), "stdev_ns": STDEVS_NS},
    more=SIGHTS,
)
DIFFERENCES = document(
    "tdoa",
    {"reference_station_id": st.just("bs9"), "range_difference_m": number(-1e6, 1e6), "stdev_m": STDEVS_M},
    {"reference_station_id": st.just("bs9"), "delay_difference_ns": number(-1e6, 1e6), "stdev_ns": STDEVS_NS},
)
STRENGTHS = st.builds(
    lambda length, log_stdev, exponent: {
        "type": "rssi",
        "station_id": "bs1",
        **strength_of(LogRange(station_id="bs1", path_length=length, log_stdev=log_stdev), exponent),
    },
    number(-3.0, 6.0).map(lambda power: min(max(10.0**power, 1e-3), 1e6)),
    number(2.4e-3, 1.5),
    number(0.5, 10.0),
).filter(lambda strength: is_read({"measurements": [strength]}))
REPORTS = st.fixed_dictionaries(
    {"measurements": st.lists(st.one_of(ANGLES, RANGES, ARRIVALS, DIFFERENCES, STRENGTHS), min_size=1, max_size=4)},
    optional={
        "target_id": st.text(max_size=256),
        "timestamp": st.sampled_from(["2026-01-31T10:00:00.250Z", "2016-12-31t23:59:60+00:00"]),
        "height": st.fixed_dictionaries({"z_m": number(-1e4, 1e4), "stdev_m": number(1e-3, 1e4)}),
        "confidence": number(0.01, 0.99),
    },
)


def assert_same(after: Report, before: Report) -> None:
    """Compare all that two reports hold, azimuths within the turn; numbers to nine digits."""
    assert replace(after, measurements=()) == replace(before, measurements=())
    for one, other in zip(after.measurements, before.measurements, strict=True):
        assert type(one) is type(other)
        for field in fields(other):
            value, expected = getattr(one, field.name), getattr(other, field.name)
            if field.name == "azimuth":
                assert math.remainder(value - expected, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-13)
            elif isinstance(expected, float):
                assert value == pytest.approx(expected, rel=1e-9, abs=1e-13)
            else:
                assert value == expected


@settings(deadline=None, max_examples=500)
@given(REPORTS)
def test_what_is_read_is_written_as_itself(document: dict[str, Any]):
    """A report with a deviation of less than 1 um, or with a strength far off, was written as one that is refused."""
    report = parse_report(document)
    written = json.loads(json.dumps(report_to_document(report), allow_nan=False))
    again = parse_report(written)
    assert_same(again, report)
    assert_same(parse_report(report_to_document(again)), report)


ANGLE = Angle(station_id="bs1", azimuth=1.0, azimuth_stdev=0.1)
FULL = replace(ANGLE, zenith=1.0, zenith_stdev=0.1)
RANGE = Range(station_id="bs1", path_length=10.0, stdev=1.0)
ARRIVAL = TimeOfArrival(station_id="bs1", path_length=10.0, stdev=1.0)
DIFFERENCE = TimeDifference(station_id="bs1", reference_station_id="bs2", length_difference=1.0, stdev=1.0)
STRENGTH = LogRange(station_id="bs1", path_length=10.0, log_stdev=0.5)
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("measurement", "words"),
    [
        (replace(ANGLE, azimuth=NAN), "azimuth_deg is NaN"),
        (replace(ANGLE, azimuth=-INF), "azimuth_deg is infinite"),
        (replace(ANGLE, azimuth_stdev=7.0), "azimuth_stdev_deg is 401"),
        (replace(ANGLE, azimuth_stdev=0.0), "azimuth_stdev_deg is 0.0"),
        (replace(ANGLE, correlation=0.5), "zenith_deg is missing although correlation is there"),
        (replace(ANGLE, zenith=1.0), "zenith_stdev_deg is missing"),
        (replace(ANGLE, zenith_stdev=1.0), "zenith_deg is missing"),
        (replace(FULL, zenith=3.2), "zenith_deg is 183"),
        (replace(FULL, correlation=1.0), "correlation is 1.0"),
        (replace(FULL, los_probability=1.5), "los_probability is 1.5"),
        (replace(FULL, station_id=""), "station_id is ''"),
        (replace(FULL, station_id="b" * 129), "station_id is 'bbb"),
        (replace(FULL, frame="body"), "frame is 'body'"),  # type: ignore[arg-type]
        (replace(RANGE, path_length=2e6), "range_m is 2000000.0"),
        (replace(RANGE, stdev=0.0), "stdev_ns is 0.0"),
        (replace(RANGE, stdev=1e-8), "stdev_ns is 6.67"),
        (replace(RANGE, stdev=-1.0), "stdev_ns is -"),
        (replace(RANGE, stdev=NAN), "stdev_m is NaN"),
        (replace(RANGE, error_model=ErrorModel(tail_share=1e-4, tail_scale=3.0)), "tail_share is 0.0001"),
        (replace(RANGE, error_model=ErrorModel(tail_share=0.1, tail_scale=100.0)), "tail_scale is 100.0"),
        (replace(ARRIVAL, path_length=INF), "range_m is infinite"),
        (replace(ARRIVAL, stdev=1e7), "stdev_m is 10000000.0"),
        (replace(DIFFERENCE, reference_station_id="bs1"), "the station itself"),
        (replace(DIFFERENCE, length_difference=-2e6), "range_difference_m is -2000000.0"),
        (replace(STRENGTH, path_length=0.0), "is of a path of 0.0 m"),
        (replace(STRENGTH, path_length=-1.0), "is of a path of -1.0 m"),
        (replace(STRENGTH, log_stdev=NAN), "a deviation of its logarithm of nan"),
        (replace(STRENGTH, path_length=1e-4), "is of a path of 0.0001 m"),
        (replace(STRENGTH, path_length=1e7), "is of a path of 1e+07 m"),
        (replace(STRENGTH, log_stdev=1.6), "leaves the distance open"),
        (replace(STRENGTH, log_stdev=1e-3), "shadowing_stdev_db is"),
    ],
)
def test_what_a_document_cannot_carry_is_refused_where_it_is_written(measurement: Measurement, words: str):
    """The document was written, without a word or with a zenith angle left out, and refused by who read it."""
    with pytest.raises(InvalidReportError) as refused:
        report_to_document(Report(measurements=(ANGLE, measurement)))
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "changes",
    [
        {"measurements": ()},
        {"measurements": (RANGE,) * 257},
        {"height": Height(z=1e5, stdev=1.0)},
        {"height": Height(z=1.0, stdev=0.0)},
        {"confidence": 1.0},
        {"target_id": "t" * 257},
        {"timestamp": "yesterday"},
    ],
)
def test_what_is_no_report_is_refused_where_it_is_written(changes: dict[str, Any]):
    with pytest.raises(InvalidReportError, match=next(iter(changes))):
        report_to_document(replace(Report(measurements=(RANGE,)), **changes))


@pytest.mark.parametrize("model", [ErrorModel(tail_share=0.0, tail_scale=5.0), ErrorModel(tail_share=0.5)])
def test_a_model_that_is_gaussian_by_its_numbers_is_written_as_one(model: ErrorModel):
    (again,) = parse_report(report_to_document(Report(measurements=(replace(RANGE, error_model=model),)))).measurements
    assert again == replace(RANGE, error_model=GAUSSIAN)


@given(st.floats(-100.0, 100.0))
def test_an_azimuth_beyond_a_turn_is_written_within_it(azimuth: float):
    report = Report(measurements=(replace(FULL, azimuth=azimuth, error_model=HEAVY_TAILED),))
    (again,) = parse_report(report_to_document(report)).measurements
    assert isinstance(again, Angle)
    assert math.remainder(again.azimuth - azimuth, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-12)


@settings(deadline=None, max_examples=100)
@given(
    st.sampled_from([example["value"] for example in NRPPA_EXAMPLES.values()]),
    number(1e-6, 360.0),
    number(1e-6, 1e6),
)
def test_reports_of_nrppa_can_be_written(message: dict[str, Any], angle_stdev: float, time_stdev: float):
    """With the largest deviations, the quantisation made them larger than a report takes."""
    report = parse_nrppa({**message, "angle_stdev_deg": angle_stdev, "time_stdev_m": time_stdev}).report
    for n in range(len(report.measurements)):
        measurement = replace(report.measurements[n], los_probability=0.5)  # type: ignore[arg-type]
        one = Report(measurements=(measurement,))
        assert_same(parse_report(report_to_document(one)), one)


@settings(deadline=None, max_examples=100)
@given(number(0.0, 360.0), number(-90.0, 90.0), number(0.0, 1e6), number(1e-6, 360.0))
def test_reports_of_silabs_can_be_written(stdev: float, elevation: float, distance: float, least: float):
    message = SILABS_EXAMPLES["three_locators"]["value"]
    angle = {
        **message["angles"][0],
        "azimuth_stdev": stdev,
        "elevation": elevation,
        "elevation_stdev": stdev,
        "distance": distance,
        "distance_stdev": distance,
    }
    report = parse_silabs({**message, "angles": [angle], "least_stdev_deg": least}).report
    assert_same(parse_report(report_to_document(report)), report)
