"""The JSON contract: what it refuses, and that each refusal names the culprit and the remedy."""

import json
import math
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rayfix_service.fusion.measurements.report import ErrorModel
from rayfix_service.wire import (
    MAX_MEASUREMENTS,
    InvalidReportError,
    MalformedJsonError,
    parse_report,
    path_text,
    problems_of,
)
from rayfix_tables.errors import ReportError
from tests.support.messages.measurements import AOA, PT, RSSI, TDOA, TOA, report_with

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
    "no type": (report_with(AOA, "type"), (*M0, "type"), ["missing", "aoa, pt, toa, tdoa, rssi"]),
    "unknown type": (report_with(AOA, type="csi"), (*M0, "type"), ["'csi'", "aoa, pt, toa, tdoa"]),
    "type number": (report_with(AOA, type=7), (*M0, "type"), ["7", "aoa, pt, toa, tdoa"]),
    "type array": (report_with(AOA, type=["aoa"]), (*M0, "type"), ["array", "aoa, pt, toa, tdoa"]),
    "azimuth 720": (report_with(AOA, azimuth_deg=720), (*M0, "azimuth_deg"), ["720", "-180 to 360", "360 off"]),
    "azimuth NaN": (report_with(AOA, azimuth_deg=math.nan), (*M0, "azimuth_deg"), ["NaN", "-180 to 360"]),
    "azimuth inf": (report_with(AOA, azimuth_deg=-math.inf), (*M0, "azimuth_deg"), ["infinite", "-180 to 360"]),
    "azimuth 10^400": (report_with(AOA, azimuth_deg=10**400), (*M0, "azimuth_deg"), ["digits", "-180 to 360"]),
    "azimuth text": (report_with(AOA, azimuth_deg="41.2"), (*M0, "azimuth_deg"), ["'41.2'", "in degrees"]),
    "azimuth true": (report_with(AOA, azimuth_deg=True), (*M0, "azimuth_deg"), ["true", "in degrees"]),
    "azimuth null": (report_with(AOA, azimuth_deg=None), (*M0, "azimuth_deg"), ["null", "in degrees"]),
    "no azimuth": (report_with(AOA, "azimuth_deg"), (*M0, "azimuth_deg"), ["missing", "in degrees"]),
    "negative deviation": (
        report_with(AOA, azimuth_stdev_deg=-1),
        (*M0, "azimuth_stdev_deg"),
        ["-1", "positive"],
    ),
    "no deviation at all": (report_with(PT, stdev_m=0), (*M0, "stdev_m"), ["0", "positive", "metres"]),
    "denormal deviation": (report_with(PT, stdev_m=5e-324), (*M0, "stdev_m"), ["5e-324", "positive"]),
    "zenith 181": (
        report_with(AOA, zenith_deg=181, zenith_stdev_deg=1),
        (*M0, "zenith_deg"),
        ["181", "0 to 180", "90 minus"],
    ),
    "zenith without stdev": (
        report_with(AOA, zenith_deg=90),
        (*M0, "zenith_stdev_deg"),
        ["missing", "zenith_deg", "both or neither"],
    ),
    "zenith stdev alone": (
        report_with(AOA, zenith_stdev_deg=1),
        (*M0, "zenith_deg"),
        ["missing", "zenith_stdev_deg", "both or neither"],
    ),
    "unknown frame": (report_with(AOA, frame="body"), (*M0, "frame"), ["'body'", "scene", "lcs", "north"]),
    "misspelt key": (
        report_with(AOA, "azimuth_deg", azimut_deg=1),
        (*M0, "azimut_deg"),
        ["unknown key", "did you mean azimuth_deg?"],
    ),
    "unknown key": (report_with(PT, colour=-60), (*M0, "colour"), ["unknown key", "leave it out", "range_m"]),
    "unknown key of the report": ({"measurements": [PT], "x": 1}, ("x",), ["unknown key", "target_id"]),
    "key that is no text": ({"measurements": [PT], 1: 1}, (1,), ["unknown key"]),
    "station empty": (report_with(PT, station_id=""), (*M0, "station_id"), ["''", "1 to 128 characters"]),
    "station long": (report_with(PT, station_id="x" * 129), (*M0, "station_id"), ["xxx...", "1 to 128"]),
    "station number": (report_with(PT, station_id=1), (*M0, "station_id"), ["is 1;", "identifier"]),
    "neither form": (report_with(PT, "range_m", "stdev_m"), M0, ["neither", "delay_ns with stdev_ns"]),
    "both forms": (report_with(PT, delay_ns=26, stdev_ns=1), M0, ["range_m", "delay_ns", "not both"]),
    "mixed forms": (report_with(PT, "stdev_m", stdev_ns=1), M0, ["range_m", "stdev_ns", "not both"]),
    "range without stdev": (report_with(TOA, "stdev_m"), M0, ["has range_m", "range_m with stdev_m"]),
    "toa since 1970": (report_with(TOA, range_m=5.3e17), (*M0, "range_m"), ["5.3e+17", "common epoch"]),
    "difference without stdev": (report_with(TDOA, "stdev_m"), M0, ["range_difference_m with stdev_m"]),
    "tdoa with itself": (
        report_with(TDOA, station_id="bs1"),
        (*M0, "reference_station_id"),
        ["'bs1'", "the station itself", "name the other"],
    ),
    "tdoa without reference": (
        report_with(TDOA, "reference_station_id"),
        (*M0, "reference_station_id"),
        ["missing", "identifier of a station"],
    ),
    "target number": ({"measurements": [PT], "target_id": 7}, ("target_id",), ["is 7;", "your name"]),
    "target long": ({"measurements": [PT], "target_id": "x" * 257}, ("target_id",), ["256 characters"]),
    "arrival without departure": (
        report_with(PT, "range_m", "stdev_m", toa_ns=1, stdev_ns=1),
        M0,
        ["has toa_ns", "tod_ns"],
    ),
    "round trip without reply": (
        report_with(PT, "range_m", "stdev_m", round_trip_ns=1, stdev_ns=1),
        M0,
        ["has round_trip_ns", "reply_ns"],
    ),
    "times of two clocks": (
        report_with(PT, "range_m", "stdev_m", toa_ns=1e9, tod_ns=0, stdev_ns=1),
        M0,
        ["3e+08 m", "one clock"],
    ),
    "negative reply": (
        report_with(PT, "range_m", "stdev_m", round_trip_ns=1, reply_ns=-1, stdev_ns=1),
        (*M0, "reply_ns"),
        ["-1", "0 to 1e+12"],
    ),
    "correlation of 1": (
        report_with(AOA, zenith_deg=90, zenith_stdev_deg=1, correlation=1),
        (*M0, "correlation"),
        ["-0.999 to 0.999"],
    ),
    "correlation without zenith": (report_with(AOA, correlation=0.5), (*M0, "zenith_deg"), ["missing", "correlation"]),
    "unknown error model": (
        report_with(PT, error_model="student"),
        (*M0, "error_model"),
        ["'student'", "heavy_tailed"],
    ),
    "tails of a Gaussian": (report_with(TOA, tail_share=0.1), (*M0, "tail_share"), ["heavy_tailed", "leave it out"]),
    "tails that are none": (
        report_with(TDOA, error_model="heavy_tailed", tail_scale=1.0),
        (*M0, "tail_scale"),
        ["1.0", "1.5 to 20"],
    ),
    "more tail than middle": (
        report_with(AOA, error_model="heavy_tailed", tail_share=0.6),
        (*M0, "tail_share"),
        ["0.6", "0.001 to 0.5"],
    ),
    "rssi without model": (
        report_with(RSSI, "path_loss_exponent"),
        (*M0, "path_loss_exponent"),
        ["missing", "0.5 to 10"],
    ),
    "rssi of the next town": (report_with(RSSI, rssi_dbm=-190), (*M0, "rssi_dbm"), ["check power_at_1m_dbm"]),
    "rssi of any distance": (
        report_with(RSSI, shadowing_stdev_db=14.9),
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
    "a Python object": (report_with(PT, range_m=1j), (*M0, "range_m"), ["complex", "metres"]),
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
    body = json.dumps(report_with(AOA, azimuth_deg=0)).replace('"azimuth_deg": 0', f'"azimuth_deg": {literal}')
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
