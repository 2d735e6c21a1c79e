"""The JSON contract: what it takes, and how units come across."""

import json
import math
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rayfix_service.fusion.measurements.report import (
    HEAVY_TAILED,
    Angle,
    ErrorModel,
    Height,
    LogRange,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.http.openapi.examples import BATCH_EXAMPLES, REPORT_EXAMPLES
from rayfix_service.wire import InvalidReportError, parse_report
from tests.support.checkout import ROOT
from tests.support.messages.measurements import AOA, PT, RSSI, TDOA, TOA, report_with

SPEED_OF_LIGHT = 299_792_458.0  # m/s


def only(document: Any) -> Any:
    (measurement,) = parse_report(document).measurements
    return measurement


def test_every_kind_of_measurement_comes_across():
    document = {
        "target_id": "agv-7",
        "timestamp": "2026-01-31T10:00:00.250Z",
        "height": {"z_m": 1.2, "stdev_m": 0.1},
        "measurements": [
            {**AOA, "azimuth_deg": 90, "zenith_deg": 180, "zenith_stdev_deg": 2, "frame": "lcs", "correlation": -0.5},
            {**PT, "error_model": "heavy_tailed"},
            RSSI,
            TOA,
            TDOA,
        ],
    }
    expected = Report(
        target_id="agv-7",
        timestamp="2026-01-31T10:00:00.250Z",
        height=Height(z=1.2, stdev=0.1),
        measurements=(
            Angle(
                station_id="bs1",
                azimuth=math.pi / 2,
                azimuth_stdev=math.pi / 180,
                zenith=math.pi,
                zenith_stdev=math.pi / 90,
                frame="lcs",
                correlation=-0.5,
            ),
            Range(station_id="bs1", path_length=7.9, stdev=0.5, error_model=HEAVY_TAILED),
            LogRange(station_id="bs1", path_length=math.exp(19 * math.log(10) / 20), log_stdev=math.log(10) / 20 * 4),
            TimeOfArrival(station_id="bs2", path_length=131.0, stdev=0.5),
            TimeDifference(station_id="bs3", reference_station_id="bs1", length_difference=2.1, stdev=0.7),
        ),
    )
    assert parse_report(document) == expected
    assert parse_report(json.dumps(document).encode()) == expected


@pytest.mark.parametrize(
    ("form", "length", "stdev"),
    [
        ({"toa_ns": 9e11 + 40.0, "tod_ns": 9e11, "stdev_ns": 2.0}, 40e-9 * SPEED_OF_LIGHT, 2e-9 * SPEED_OF_LIGHT),
        ({"round_trip_ns": 1280.0, "reply_ns": 1200.0, "stdev_ns": 2.0}, 40e-9 * SPEED_OF_LIGHT, 1e-9 * SPEED_OF_LIGHT),
        ({"round_trip_ns": 80, "reply_ns": 0, "stdev_ns": 2}, 40e-9 * SPEED_OF_LIGHT, 1e-9 * SPEED_OF_LIGHT),
    ],
)
def test_propagation_times_come_as_the_times_that_were_measured(form: dict[str, float], length: float, stdev: float):
    measurement = only(report_with(PT, "range_m", "stdev_m", **form))
    assert measurement.path_length == pytest.approx(length, abs=1e-4)  # what is left of 1e12 ns
    assert measurement.stdev == pytest.approx(stdev)


@pytest.mark.parametrize("base", ["AOA", "PT", "TOA", "TDOA"])
def test_every_kind_but_a_power_may_have_heavy_tails(base: str):
    document = {"AOA": AOA, "PT": PT, "TOA": TOA, "TDOA": TDOA}[base]
    assert only(report_with(document, error_model="heavy_tailed")).error_model == HEAVY_TAILED
    found = only(report_with(document, error_model="heavy_tailed", tail_share=0.3, tail_scale=5)).error_model
    assert found == ErrorModel(tail_share=0.3, tail_scale=5.0)
    assert only(report_with(document, error_model="gaussian")) == only(report_with(document))


@pytest.mark.parametrize("base", [AOA, PT, TOA])
@pytest.mark.parametrize("probability", [0, 0.3, 1.0, None])
def test_what_is_of_one_path_may_tell_of_sight(base: dict[str, Any], probability: float | None):
    assert only(report_with(base)).los_probability is None
    assert only(report_with(base, los_probability=probability)).los_probability == probability


@pytest.mark.parametrize(("base", "value"), [(AOA, 1.01), (PT, -0.1), (TOA, "0.5"), (TDOA, 0.5), (RSSI, 0.5)])
def test_other_words_of_sight_are_refused(base: dict[str, Any], value: object):
    with pytest.raises(InvalidReportError) as caught:
        parse_report(report_with(base, los_probability=value))
    assert caught.value.path == ("measurements", 0, "los_probability")


def test_what_may_be_left_out():
    report = parse_report({"measurements": [AOA]})
    assert report.target_id is None
    assert report.timestamp is None
    (angle,) = report.measurements
    assert angle.zenith is None
    assert angle.zenith_stdev is None
    assert angle.frame == "scene"


def test_null_is_as_good_as_left_out():
    document = report_with(AOA, zenith_deg=None, zenith_stdev_deg=None) | {"target_id": None, "timestamp": None}
    assert parse_report(document) == parse_report({"measurements": [AOA]})
    assert only(report_with(PT, delay_ns=None, stdev_ns=None)) == only({"measurements": [PT]})


def test_a_python_document_may_hold_tuples():
    assert parse_report({"measurements": (AOA, PT)}) == parse_report({"measurements": [AOA, PT]})


@pytest.mark.parametrize(
    ("degrees", "radians"),
    [(0, 0.0), (180, math.pi), (-180, math.pi), (270, -math.pi / 2), (360, 0.0), (-90, -math.pi / 2)],
)
def test_signed_and_unsigned_azimuths_mean_the_same(degrees: float, radians: float):
    assert only(report_with(AOA, azimuth_deg=degrees)).azimuth == pytest.approx(radians, abs=1e-15)


@given(
    azimuth=st.floats(-math.pi, math.pi, exclude_min=True),
    zenith=st.floats(0, math.pi),
    stdev=st.floats(1e-7, 1.0),
)
def test_angles_survive_the_way_there(azimuth: float, zenith: float, stdev: float):
    angle = only(
        report_with(
            AOA,
            azimuth_deg=math.degrees(azimuth),
            azimuth_stdev_deg=math.degrees(stdev),
            zenith_deg=min(math.degrees(zenith), 180.0),
            zenith_stdev_deg=math.degrees(stdev),
        )
    )
    # Next to pi, the last bit decides on which side of the cut an azimuth lands.
    assert math.remainder(angle.azimuth - azimuth, 2 * math.pi) == pytest.approx(0.0, abs=2e-15)
    assert -math.pi < angle.azimuth <= math.pi
    assert angle.zenith == pytest.approx(zenith, abs=1e-15)
    assert angle.azimuth_stdev == pytest.approx(stdev, rel=1e-15)
    assert angle.zenith_stdev == angle.azimuth_stdev


@given(length=st.floats(-1e5, 1e5), stdev=st.floats(1e-3, 1e3))
def test_delays_mean_the_same_as_lengths(length: float, stdev: float):
    delay = {"delay_ns": length / SPEED_OF_LIGHT * 1e9, "stdev_ns": stdev / SPEED_OF_LIGHT * 1e9}
    for base in (PT, TOA):
        measurement = only(report_with(base, "range_m", "stdev_m", **delay))
        assert measurement.path_length == pytest.approx(length, rel=1e-15, abs=1e-300)
        assert measurement.stdev == pytest.approx(stdev, rel=1e-15)
    delay["delay_difference_ns"] = delay.pop("delay_ns")
    difference = only(report_with(TDOA, "range_difference_m", "stdev_m", **delay))
    assert difference.length_difference == pytest.approx(length, rel=1e-15, abs=1e-300)
    assert difference.stdev == pytest.approx(stdev, rel=1e-15)


@pytest.mark.parametrize(
    "timestamp",
    [
        "2026-01-31T10:00:00Z",
        "2026-01-31T10:00:00.123456789+05:30",
        "2026-01-31t10:00:00z",
        "2016-12-31T23:59:60Z",  # a leap second
        "2024-02-29T00:00:00-00:00",
    ],
)
def test_timestamps_are_kept_as_given(timestamp: str):
    assert parse_report({"timestamp": timestamp, "measurements": [PT]}).timestamp == timestamp


def test_a_confidence_comes_across():
    assert parse_report({"measurements": [PT], "confidence": 0.95}).confidence == 0.95
    assert parse_report({"measurements": [PT]}).confidence == 0.68


def documented() -> list[dict[str, Any]]:
    """All whole JSON objects of docs/measurements.md."""
    text = (ROOT / "docs" / "measurements.md").read_text(encoding="utf-8")
    decoder, found = json.JSONDecoder(), []
    for block in re.findall(r"```json\n(\{.*?)```", text, re.DOTALL):
        rest = block.strip()
        while rest:
            document, end = decoder.raw_decode(rest)
            found.append(document)
            rest = rest[end:].strip()
    return found


def test_the_documented_measurements_are_taken():
    kinds = set()
    for document in documented():
        report = document if "measurements" in document else {"measurements": [document]}
        kinds |= {measurement["type"] for measurement in report["measurements"]}
        assert parse_report(report).measurements
    assert kinds == {"aoa", "pt", "toa", "tdoa", "rssi", "path"}
    assert len(documented()) == 10


@pytest.mark.parametrize("example", [*REPORT_EXAMPLES.values()], ids=[*REPORT_EXAMPLES])
def test_the_examples_are_reports(example: dict[str, Any]):
    assert len(parse_report(example["value"]).measurements) == len(example["value"]["measurements"])


def test_the_batch_examples_hold_reports():
    for batch in BATCH_EXAMPLES.values():
        for report in batch["value"]["reports"]:
            parse_report(report)


def test_a_byte_order_mark_is_passed_over() -> None:
    text = b'{"measurements": [{"type": "pt", "station_id": "bs1", "range_m": 6.0, "stdev_m": 0.15}]}'
    assert parse_report(b"\xef\xbb\xbf" + text) == parse_report(text)
