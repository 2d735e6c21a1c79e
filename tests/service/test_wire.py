"""The JSON contract: what it takes, what it refuses, and how units come across."""

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import chi2

from rayfix_service.fusion.credible import CredibleRegions
from rayfix_service.fusion.normal import normal_points
from rayfix_service.fusion.report import (
    HEAVY_TAILED,
    Angle,
    Candidate,
    ErrorModel,
    Fix,
    Height,
    LogRange,
    Outcome,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.http.examples import BATCH_EXAMPLES, FIX_EXAMPLE, REPORT_EXAMPLES
from rayfix_service.wire import (
    MAX_MEASUREMENTS,
    FixDocument,
    InvalidReportError,
    MalformedJsonError,
    fix_to_document,
    parse_report,
    path_text,
    problems_of,
    report_to_document,
)
from rayfix_tables.errors import ReportError

SPEED_OF_LIGHT = 299_792_458.0  # m/s

AOA = {"type": "aoa", "station_id": "bs1", "azimuth_deg": 41.2, "azimuth_stdev_deg": 1.0}
PT = {"type": "pt", "station_id": "bs1", "range_m": 7.9, "stdev_m": 0.5}
TOA = {"type": "toa", "station_id": "bs2", "range_m": 131.0, "stdev_m": 0.5}
TDOA = {
    "type": "tdoa",
    "station_id": "bs3",
    "reference_station_id": "bs1",
    "range_difference_m": 2.1,
    "stdev_m": 0.7,
}
RSSI = {
    "type": "rssi",
    "station_id": "bs1",
    "rssi_dbm": -61.0,
    "power_at_1m_dbm": -42.0,
    "path_loss_exponent": 2.0,
    "shadowing_stdev_db": 4.0,
}


def changed(measurement: dict[str, Any], *without: str, **values: Any) -> dict[str, Any]:
    """Report of one measurement, with some keys left out and others set."""
    kept = {key: value for key, value in measurement.items() if key not in without}
    return {"measurements": [{**kept, **values}]}


def only(document: Any) -> Any:
    (measurement,) = parse_report(document).measurements
    return measurement


# --- what comes across -----------------------------------------------------------------------------------


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
    measurement = only(changed(PT, "range_m", "stdev_m", **form))
    assert measurement.path_length == pytest.approx(length, abs=1e-4)  # what is left of 1e12 ns
    assert measurement.stdev == pytest.approx(stdev)


@pytest.mark.parametrize("base", ["AOA", "PT", "TOA", "TDOA"])
def test_every_kind_but_a_power_may_have_heavy_tails(base: str):
    document = {"AOA": AOA, "PT": PT, "TOA": TOA, "TDOA": TDOA}[base]
    assert only(changed(document, error_model="heavy_tailed")).error_model == HEAVY_TAILED
    found = only(changed(document, error_model="heavy_tailed", tail_share=0.3, tail_scale=5)).error_model
    assert found == ErrorModel(tail_share=0.3, tail_scale=5.0)
    assert only(changed(document, error_model="gaussian")) == only(changed(document))


def test_what_may_be_left_out():
    report = parse_report({"measurements": [AOA]})
    assert report.target_id is None
    assert report.timestamp is None
    (angle,) = report.measurements
    assert angle.zenith is None
    assert angle.zenith_stdev is None
    assert angle.frame == "scene"


def test_null_is_as_good_as_left_out():
    document = changed(AOA, zenith_deg=None, zenith_stdev_deg=None) | {"target_id": None, "timestamp": None}
    assert parse_report(document) == parse_report({"measurements": [AOA]})
    assert only(changed(PT, delay_ns=None, stdev_ns=None)) == only({"measurements": [PT]})


def test_a_python_document_may_hold_tuples():
    assert parse_report({"measurements": (AOA, PT)}) == parse_report({"measurements": [AOA, PT]})


@pytest.mark.parametrize(
    ("degrees", "radians"),
    [(0, 0.0), (180, math.pi), (-180, math.pi), (270, -math.pi / 2), (360, 0.0), (-90, -math.pi / 2)],
)
def test_signed_and_unsigned_azimuths_mean_the_same(degrees: float, radians: float):
    assert only(changed(AOA, azimuth_deg=degrees)).azimuth == pytest.approx(radians, abs=1e-15)


@given(
    azimuth=st.floats(-math.pi, math.pi, exclude_min=True),
    zenith=st.floats(0, math.pi),
    stdev=st.floats(1e-7, 1.0),
)
def test_angles_survive_the_way_there(azimuth: float, zenith: float, stdev: float):
    angle = only(
        changed(
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
        measurement = only(changed(base, "range_m", "stdev_m", **delay))
        assert measurement.path_length == pytest.approx(length, rel=1e-15, abs=1e-300)
        assert measurement.stdev == pytest.approx(stdev, rel=1e-15)
    delay["delay_difference_ns"] = delay.pop("delay_ns")
    difference = only(changed(TDOA, "range_difference_m", "stdev_m", **delay))
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


@pytest.mark.parametrize(
    "timestamp",
    [
        "",
        "now",
        "2026-01-31",
        "2026-01-31T10:00:00",  # no offset
        "2026-02-29T10:00:00Z",  # no such day
        "2026-01-31T24:00:00Z",
        "2026-01-31T10:60:00Z",
        "2026-01-31T10:00:61Z",
        "2026-01-31T10:00:00+24:00",
        "2026-W05-6T10:00:00Z",
        "2026-01-31T10:00:00Z\n",
        "\uff12026-01-31T10:00:00Z",  # a full-width digit
    ],
)
def test_other_timestamps_are_refused(timestamp: str):
    with pytest.raises(InvalidReportError, match="RFC 3339") as caught:
        parse_report({"timestamp": timestamp, "measurements": [PT]})
    assert caught.value.path == ("timestamp",)


def documented() -> list[dict[str, Any]]:
    """All whole JSON objects of docs/measurements.md."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "measurements.md").read_text(encoding="utf-8")
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
    assert kinds == {"aoa", "pt", "toa", "tdoa", "rssi"}
    assert len(documented()) == 9


@pytest.mark.parametrize("example", [*REPORT_EXAMPLES.values()], ids=[*REPORT_EXAMPLES])
def test_the_examples_are_reports(example: dict[str, Any]):
    assert len(parse_report(example["value"]).measurements) == len(example["value"]["measurements"])


def test_the_batch_examples_hold_reports():
    for batch in BATCH_EXAMPLES.values():
        for report in batch["value"]["reports"]:
            parse_report(report)


# --- what is refused -------------------------------------------------------------------------------------

M0 = ("measurements", 0)

BAD: dict[str, tuple[Any, tuple[str | int, ...], list[str]]] = {
    # name: document, path of the first problem, what its message must say
    "number": (5, (), ["5", "JSON object"]),
    "null": (None, (), ["null", "JSON object"]),
    "array": ([AOA], (), ["array", "JSON object"]),
    "empty object": ({}, ("measurements",), ["missing", "1 to 256"]),
    "no measurement": ({"measurements": []}, ("measurements",), ["length 0", "1 to 256"]),
    "too many": ({"measurements": [PT] * 257}, ("measurements",), ["length 257", "1 to 256"]),
    "confidence 1": ({"measurements": [PT], "confidence": 1}, ("confidence",), ["is 1", "0.01 to 0.99"]),
    "confidence %": ({"measurements": [PT], "confidence": "95%"}, ("confidence",), ["'95%'", "0.01 to 0.99"]),
    "measurements object": ({"measurements": AOA}, ("measurements",), ["an object", "give an array"]),
    "measurement text": ({"measurements": ["x"]}, M0, ["'x'", "JSON object"]),
    "no type": (changed(AOA, "type"), (*M0, "type"), ["missing", "aoa, pt, toa, tdoa, rssi"]),
    "unknown type": (changed(AOA, type="csi"), (*M0, "type"), ["'csi'", "aoa, pt, toa, tdoa"]),
    "type number": (changed(AOA, type=7), (*M0, "type"), ["7", "aoa, pt, toa, tdoa"]),
    "type array": (changed(AOA, type=["aoa"]), (*M0, "type"), ["array", "aoa, pt, toa, tdoa"]),
    "azimuth 720": (changed(AOA, azimuth_deg=720), (*M0, "azimuth_deg"), ["720", "-180 to 360", "360 off"]),
    "azimuth NaN": (changed(AOA, azimuth_deg=math.nan), (*M0, "azimuth_deg"), ["NaN", "-180 to 360"]),
    "azimuth inf": (changed(AOA, azimuth_deg=-math.inf), (*M0, "azimuth_deg"), ["infinite", "-180 to 360"]),
    "azimuth 10^400": (changed(AOA, azimuth_deg=10**400), (*M0, "azimuth_deg"), ["digits", "-180 to 360"]),
    "azimuth text": (changed(AOA, azimuth_deg="41.2"), (*M0, "azimuth_deg"), ["'41.2'", "in degrees"]),
    "azimuth true": (changed(AOA, azimuth_deg=True), (*M0, "azimuth_deg"), ["true", "in degrees"]),
    "azimuth null": (changed(AOA, azimuth_deg=None), (*M0, "azimuth_deg"), ["null", "in degrees"]),
    "no azimuth": (changed(AOA, "azimuth_deg"), (*M0, "azimuth_deg"), ["missing", "in degrees"]),
    "negative deviation": (
        changed(AOA, azimuth_stdev_deg=-1),
        (*M0, "azimuth_stdev_deg"),
        ["-1", "positive"],
    ),
    "no deviation at all": (changed(PT, stdev_m=0), (*M0, "stdev_m"), ["0", "positive", "metres"]),
    "denormal deviation": (changed(PT, stdev_m=5e-324), (*M0, "stdev_m"), ["5e-324", "positive"]),
    "zenith 181": (
        changed(AOA, zenith_deg=181, zenith_stdev_deg=1),
        (*M0, "zenith_deg"),
        ["181", "0 to 180", "90 minus"],
    ),
    "zenith without stdev": (
        changed(AOA, zenith_deg=90),
        (*M0, "zenith_stdev_deg"),
        ["missing", "zenith_deg", "both or neither"],
    ),
    "zenith stdev alone": (
        changed(AOA, zenith_stdev_deg=1),
        (*M0, "zenith_deg"),
        ["missing", "zenith_stdev_deg", "both or neither"],
    ),
    "unknown frame": (changed(AOA, frame="body"), (*M0, "frame"), ["'body'", "scene", "lcs", "north"]),
    "misspelt key": (
        changed(AOA, "azimuth_deg", azimut_deg=1),
        (*M0, "azimut_deg"),
        ["unknown key", "did you mean azimuth_deg?"],
    ),
    "unknown key": (changed(PT, colour=-60), (*M0, "colour"), ["unknown key", "leave it out", "range_m"]),
    "unknown key of the report": ({"measurements": [PT], "x": 1}, ("x",), ["unknown key", "target_id"]),
    "key that is no text": ({"measurements": [PT], 1: 1}, (1,), ["unknown key"]),
    "station empty": (changed(PT, station_id=""), (*M0, "station_id"), ["''", "1 to 128 characters"]),
    "station long": (changed(PT, station_id="x" * 129), (*M0, "station_id"), ["xxx...", "1 to 128"]),
    "station number": (changed(PT, station_id=1), (*M0, "station_id"), ["is 1;", "identifier"]),
    "neither form": (changed(PT, "range_m", "stdev_m"), M0, ["neither", "delay_ns with stdev_ns"]),
    "both forms": (changed(PT, delay_ns=26, stdev_ns=1), M0, ["range_m", "delay_ns", "not both"]),
    "mixed forms": (changed(PT, "stdev_m", stdev_ns=1), M0, ["range_m", "stdev_ns", "not both"]),
    "range without stdev": (changed(TOA, "stdev_m"), M0, ["has range_m", "range_m with stdev_m"]),
    "toa since 1970": (changed(TOA, range_m=5.3e17), (*M0, "range_m"), ["5.3e+17", "common epoch"]),
    "difference without stdev": (changed(TDOA, "stdev_m"), M0, ["range_difference_m with stdev_m"]),
    "tdoa with itself": (
        changed(TDOA, station_id="bs1"),
        (*M0, "reference_station_id"),
        ["'bs1'", "the station itself", "name the other"],
    ),
    "tdoa without reference": (
        changed(TDOA, "reference_station_id"),
        (*M0, "reference_station_id"),
        ["missing", "identifier of a station"],
    ),
    "target number": ({"measurements": [PT], "target_id": 7}, ("target_id",), ["is 7;", "your name"]),
    "target long": ({"measurements": [PT], "target_id": "x" * 257}, ("target_id",), ["256 characters"]),
    "arrival without departure": (
        changed(PT, "range_m", "stdev_m", toa_ns=1, stdev_ns=1),
        M0,
        ["has toa_ns", "tod_ns"],
    ),
    "round trip without reply": (
        changed(PT, "range_m", "stdev_m", round_trip_ns=1, stdev_ns=1),
        M0,
        ["has round_trip_ns", "reply_ns"],
    ),
    "times of two clocks": (
        changed(PT, "range_m", "stdev_m", toa_ns=1e9, tod_ns=0, stdev_ns=1),
        M0,
        ["3e+08 m", "one clock"],
    ),
    "negative reply": (
        changed(PT, "range_m", "stdev_m", round_trip_ns=1, reply_ns=-1, stdev_ns=1),
        (*M0, "reply_ns"),
        ["-1", "0 to 1e+12"],
    ),
    "correlation of 1": (
        changed(AOA, zenith_deg=90, zenith_stdev_deg=1, correlation=1),
        (*M0, "correlation"),
        ["-0.999 to 0.999"],
    ),
    "correlation without zenith": (changed(AOA, correlation=0.5), (*M0, "zenith_deg"), ["missing", "correlation"]),
    "unknown error model": (changed(PT, error_model="student"), (*M0, "error_model"), ["'student'", "heavy_tailed"]),
    "tails of a Gaussian": (changed(TOA, tail_share=0.1), (*M0, "tail_share"), ["heavy_tailed", "leave it out"]),
    "tails that are none": (
        changed(TDOA, error_model="heavy_tailed", tail_scale=1.0),
        (*M0, "tail_scale"),
        ["1.0", "1.5 to 20"],
    ),
    "more tail than middle": (
        changed(AOA, error_model="heavy_tailed", tail_share=0.6),
        (*M0, "tail_share"),
        ["0.6", "0.001 to 0.5"],
    ),
    "rssi without model": (changed(RSSI, "path_loss_exponent"), (*M0, "path_loss_exponent"), ["missing", "0.5 to 10"]),
    "rssi of the next town": (changed(RSSI, rssi_dbm=-190), (*M0, "rssi_dbm"), ["check power_at_1m_dbm"]),
    "rssi of any distance": (
        changed(RSSI, shadowing_stdev_db=14.9),
        (*M0, "shadowing_stdev_db"),
        ["leaves the distance open"],
    ),
    "height of 20 km": ({"measurements": [PT], "height": {"z_m": 2e4, "stdev_m": 1}}, ("height", "z_m"), ["20000"]),
    "height without stdev": (
        {"measurements": [PT], "height": {"z_m": 1}},
        ("height", "stdev_m"),
        ["missing", "positive"],
    ),
    "height alone": ({"measurements": [PT], "height": 1.2}, ("height",), ["1.2", "z_m", "stdev_m"]),
    "height misspelt": (
        {"measurements": [PT], "height": {"z": 1, "stdev_m": 1}},
        ("height", "z"),
        ["unknown key", "z_m"],
    ),
    "a Python object": (changed(PT, range_m=1j), (*M0, "range_m"), ["complex", "metres"]),
}


@pytest.mark.parametrize(("document", "path", "words"), [*BAD.values()], ids=[*BAD])
def test_refusals_name_the_culprit_and_the_remedy(document: Any, path: tuple[str | int, ...], words: list[str]):
    with pytest.raises(InvalidReportError) as caught:
        parse_report(document)
    error = caught.value
    assert error.path == path
    message = str(error)
    assert "\n" not in message
    assert path_text(path) in message
    for word in words:
        assert word in message
    assert problems_of(error)[0].path == path


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"", ["empty", '{"measurements": [...]}']),
        (b" \r\n\t", ["empty", '{"measurements": [...]}']),
        (b'{"measurements": [', ["line 1 column 18", "complete"]),
        (b'{"measurements": []} {}', ["trailing", "one complete JSON object"]),
        (b"\xff\xfe{\x00}\x00", ["not JSON", "UTF-8"]),
        (b'{"target_id": "\\ud800"}', ["not JSON", "UTF-8"]),
        (b"[" * 100_000, ["recursion", "JSON"]),
        (b"9" * 10_000, ["not JSON"]),
    ],
)
def test_what_is_not_json_is_told_apart(body: bytes, words: list[str]):
    with pytest.raises(MalformedJsonError) as caught:
        parse_report(body)
    assert caught.value.path == ()
    for word in words:
        assert word in str(caught.value)
    assert len(problems_of(caught.value)) == 1


@pytest.mark.parametrize("literal", ["NaN", "Infinity", "-Infinity", "1e400", "-1e400"])
def test_numbers_that_are_not_finite_are_refused_at_their_place(literal: str):
    body = json.dumps(changed(AOA, azimuth_deg=0)).replace('"azimuth_deg": 0', f'"azimuth_deg": {literal}')
    with pytest.raises(InvalidReportError, match=r"NaN|infinite") as caught:
        parse_report(body.encode())
    assert caught.value.path == ("measurements", 0, "azimuth_deg")


def test_all_problems_come_at_once():
    with pytest.raises(InvalidReportError, match=r"\(and 2 more\)$") as caught:
        parse_report({"timestamp": "now", "measurements": [PT, {**PT, "stdev_m": -1}, {**AOA, "azimuth_deg": 720}]})
    assert [problem.path for problem in caught.value.problems] == [
        ("timestamp",),
        ("measurements", 1, "stdev_m"),
        ("measurements", 2, "azimuth_deg"),
    ]
    assert all(path_text(p.path) in p.message for p in caught.value.problems)


def test_a_flood_of_problems_is_cut_short():
    document = {"x" * 500 + str(i): i for i in range(5000)}
    with pytest.raises(InvalidReportError) as caught:
        parse_report(document)
    assert len(caught.value.problems) == 50
    assert max(len(problem.message) for problem in caught.value.problems) < 250


def test_as_many_measurements_as_allowed_are_taken():
    assert len(parse_report({"measurements": [PT] * MAX_MEASUREMENTS}).measurements) == 256


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)
KEYS = sorted(
    {*AOA, *PT, *TDOA, *RSSI, "zenith_deg", "zenith_stdev_deg", "frame", "delay_ns", "stdev_ns", "toa_ns", "tod_ns"}
    | {"round_trip_ns", "reply_ns", "correlation", "error_model", "tail_share", "tail_scale"}
)
NEAR_VALUES = (
    st.sampled_from(["aoa", "pt", "toa", "tdoa", "rssi", "heavy_tailed", "bs1", "bs2", "lcs", 1, 0.5, -1, 1e12, 1e300])
    | JSON_VALUES
)
NEAR_MEASUREMENTS = st.builds(
    lambda base, change: {**base, **change},
    st.sampled_from([AOA, PT, TOA, TDOA, RSSI, {}]),
    st.dictionaries(st.sampled_from(KEYS), NEAR_VALUES, max_size=3),
)
NEAR_REPORTS = st.builds(
    lambda measurements, rest: {**rest, "measurements": measurements},
    st.lists(NEAR_MEASUREMENTS | JSON_VALUES, max_size=3),
    st.dictionaries(st.sampled_from(["target_id", "timestamp", "height", "x"]), NEAR_VALUES, max_size=2),
)


def refuse_cleanly(document: Any) -> None:
    """Parse; every refusal must be a ReportError of one line that can be sent as JSON."""
    try:
        report = parse_report(document)
    except ReportError as error:
        for problem in problems_of(error):
            assert problem.message
            assert "\n" not in problem.message
            json.dumps([path_text(problem.path), problem.message], ensure_ascii=False).encode()
    else:
        assert 1 <= len(report.measurements) <= MAX_MEASUREMENTS
        for measurement in report.measurements:
            for value in vars(measurement).values():
                assert value is None or isinstance(value, str | ErrorModel) or math.isfinite(value)


@given(JSON_VALUES | NEAR_REPORTS)
@example({"\ud800": 1})
def test_any_document_is_taken_or_refused_cleanly(document: Any):
    refuse_cleanly(document)
    refuse_cleanly(json.dumps(document).encode())


def test_paths_are_written_as_people_do():
    assert path_text(()) == ""
    assert path_text(("measurements", 0, "azimuth_deg")) == "measurements[0].azimuth_deg"
    assert path_text((3, "a b", "\n")) == "[3]['a b']['\\n']"


@given(st.binary())
@example(b"\xef\xbb\xbf{}")
@example(b'{"\\n": 1}')
@example(b'{"measurements": [{"type": "pt", "\\u0000": 1}]}')
def test_any_bytes_are_taken_or_refused_cleanly(body: bytes):
    refuse_cleanly(body)


# --- the way back ----------------------------------------------------------------------------------------


def gaussian(xx: float, xy: float, yy: float, zz: float = 1.0) -> np.ndarray:
    return np.array([[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, zz]])


def regions_of(candidate: Candidate, share: float = 1.0) -> CredibleRegions:
    """Regions of a fix whose posterior is one Gaussian, but for this share."""
    points = candidate.position + normal_points(1024) @ np.linalg.cholesky(candidate.covariance).T
    return CredibleRegions(position=candidate.position, covariance=candidate.covariance, points=points, share=share)


@pytest.mark.parametrize(("confidence", "share"), [(0.5, 1.0), (0.68, 0.9), (0.95, 1.0), (0.95, 0.9)])
def test_the_accuracies_are_those_of_the_confidence_asked_for(confidence: float, share: float):
    candidate = Candidate(probability=0.9, position=np.array([1.0, 2.0, 0.5]), covariance=gaussian(4.0, 0.5, 2.0))
    regions = regions_of(candidate, share)
    fix = Fix(
        status="ok",
        candidates=(candidate,),
        outcomes=(),
        log_evidence=0.0,
        table_id="id",
        regions=regions,
        confidence=confidence,
    )
    document = fix_to_document(fix, 0.001)
    assert document["horizontal_accuracy_m"] == regions.horizontal_radius(confidence)
    assert document["vertical_accuracy_m"] == regions.vertical_half_height(confidence)
    axes = np.array(document["ellipsoid_semi_axes_m"])
    np.testing.assert_allclose(axes.T @ axes, regions.ellipsoid(confidence).shape, rtol=0, atol=1e-12)
    assert (np.diff(np.linalg.norm(axes, axis=1)) <= 0.0).all()
    # No region is more probable than that anything but an outlier was measured.
    assert document["confidence"] == min(confidence, share)


def test_a_confidence_comes_across():
    assert parse_report({"measurements": [PT], "confidence": 0.95}).confidence == 0.95
    assert parse_report({"measurements": [PT]}).confidence == 0.68


def test_a_fix_becomes_the_documented_answer():
    near = Candidate(probability=0.9, position=np.array([1.0, 2.0, 0.5]), covariance=gaussian(4.0, 0.0, 4.0))
    far = Candidate(probability=0.1, position=np.array([7.0, 9.0, 1.5]), covariance=np.eye(3))
    fix = Fix(
        status="ok",
        candidates=(near, far),
        outcomes=(
            Outcome(used=True, outlier_probability=0.02),
            Outcome(used=False, reason="no ray of bs1 comes from there"),
        ),
        log_evidence=-3.0,
        table_id="ab" * 32,
        regions=regions_of(near),
        target_id="agv-7",
        timestamp="2026-01-31T10:00:00.250Z",
    )
    document = json.loads(json.dumps(fix_to_document(fix, 0.0012345), allow_nan=False))
    horizontal, vertical = document.pop("horizontal_accuracy_m"), document.pop("vertical_accuracy_m")
    assert horizontal == pytest.approx(2.0 * math.sqrt(-2.0 * math.log(0.32)), rel=0.02)
    assert vertical == pytest.approx(0.994457883209753, rel=0.02)
    lengths = np.linalg.norm(document.pop("ellipsoid_semi_axes_m"), axis=1)
    np.testing.assert_allclose(lengths, math.sqrt(chi2.ppf(0.68, 3)) * np.array([2.0, 2.0, 1.0]), rtol=0.05)
    assert document == {
        "target_id": "agv-7",
        "timestamp": "2026-01-31T10:00:00.250Z",
        "status": "ok",
        "position": {"x": 1.0, "y": 2.0, "z": 0.5},
        "covariance_m2": [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]],
        "confidence": 0.68,
        "candidates": [
            {
                "probability": 0.9,
                "position": {"x": 1.0, "y": 2.0, "z": 0.5},
                "covariance_m2": [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]],
            },
            {
                "probability": 0.1,
                "position": {"x": 7.0, "y": 9.0, "z": 1.5},
                "covariance_m2": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            },
        ],
        "measurements": [
            {"index": 0, "used": True, "outlier_probability": 0.02},
            {
                "index": 1,
                "used": False,
                "outlier_probability": None,
                "reason": "no ray of bs1 comes from there",
            },
        ],
        "table_id": "ab" * 32,
        "compute_ms": 1.234,
    }


def test_a_fix_without_candidates_has_no_position():
    fix = Fix(
        status="insufficient",
        candidates=(),
        outcomes=(Outcome(used=False, reason="outside the field of view"),),
        log_evidence=0.0,
        table_id="ab" * 32,
    )
    document = fix_to_document(fix, 0.001)
    FixDocument.model_validate(document)
    assert document["status"] == "insufficient"
    assert document["candidates"] == []
    for key in (
        "position",
        "covariance_m2",
        "horizontal_accuracy_m",
        "vertical_accuracy_m",
        "ellipsoid_semi_axes_m",
        "target_id",
        "timestamp",
    ):
        assert document[key] is None


def test_answer_and_schema_have_the_same_keys():
    candidate = Candidate(probability=1.0, position=np.zeros(3), covariance=np.eye(3))
    fix = Fix(
        status="ok",
        candidates=(candidate,),
        outcomes=(Outcome(used=False, reason="x"),),
        log_evidence=0.0,
        table_id="ab" * 32,
        regions=regions_of(candidate),
    )
    document = fix_to_document(fix, 0.001)
    assert FixDocument.model_validate(document).model_dump(mode="json", exclude_unset=True) == document
    assert document.keys() == FixDocument.model_fields.keys() - {"track"}
    assert list(FIX_EXAMPLE) == list(document)
    FixDocument.model_validate(FIX_EXAMPLE)


# --- the way back ----------------------------------------------------------------------------------------

STATIONS = st.sampled_from(["bs1", "bs2", "bs3"])
METRES = st.floats(1e-3, 1e6)
ERROR_MODELS = st.one_of(
    st.just(ErrorModel()), st.builds(ErrorModel, tail_share=st.floats(1e-3, 0.5), tail_scale=st.floats(1.5, 20))
)
SINGLE_ANGLES = st.builds(
    Angle,
    station_id=STATIONS,
    azimuth=st.floats(-3.14, 3.14),
    azimuth_stdev=st.floats(1e-6, 6.0),
    frame=st.sampled_from(["scene", "lcs", "north"]),
    error_model=ERROR_MODELS,
)
FULL_ANGLES = st.builds(
    Angle,
    station_id=STATIONS,
    azimuth=st.floats(-3.14, 3.14),
    azimuth_stdev=st.floats(1e-6, 6.0),
    zenith=st.floats(0.0, 3.14),
    zenith_stdev=st.floats(1e-6, 6.0),
    correlation=st.floats(-0.99, 0.99),
)
LENGTHS = st.one_of(
    *(
        st.builds(kind, station_id=STATIONS, path_length=METRES, stdev=METRES, error_model=ERROR_MODELS)
        for kind in (Range, TimeOfArrival)
    )
)
LOG_RANGES = st.builds(LogRange, station_id=STATIONS, path_length=st.floats(0.01, 1e4), log_stdev=st.floats(0.02, 1.4))
DIFFERENCES = st.builds(
    TimeDifference,
    station_id=STATIONS,
    reference_station_id=st.just("bs4"),
    length_difference=st.floats(-1e6, 1e6),
    stdev=METRES,
)


@given(
    measurements=st.lists(
        st.one_of(SINGLE_ANGLES, FULL_ANGLES, LENGTHS, LOG_RANGES, DIFFERENCES), min_size=1, max_size=4
    ),
    height=st.none() | st.builds(Height, z=st.floats(-100, 100), stdev=st.floats(1e-3, 100)),
    confidence=st.floats(0.01, 0.99),
    target_id=st.none() | st.text(max_size=9),
)
def test_a_report_comes_back_from_its_document(
    measurements: list[Any], height: Height | None, confidence: float, target_id: str | None
):
    report = Report(
        measurements=tuple(measurements),
        height=height,
        confidence=confidence,
        target_id=target_id,
        timestamp="2026-01-31T10:00:00Z",
    )
    again = parse_report(json.dumps(report_to_document(report)).encode())
    assert (again.height, again.confidence, again.target_id, again.timestamp) == (
        height,
        confidence,
        target_id,
        report.timestamp,
    )
    for before, after in zip(report.measurements, again.measurements, strict=True):
        assert type(after) is type(before)
        for field in dataclasses.fields(before):
            value = getattr(before, field.name)
            expected = pytest.approx(value, rel=1e-9, abs=1e-13) if isinstance(value, float) else value
            assert getattr(after, field.name) == expected


@pytest.mark.parametrize("name", ["angle_and_time", "angles"])
def test_a_document_in_metres_and_degrees_is_itself_again(name: str):
    document = REPORT_EXAMPLES[name]["value"]
    assert report_to_document(parse_report(document)) == document
