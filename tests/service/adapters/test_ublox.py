"""u-blox lines: real samples, the manual's fields, joining, refusals."""

import math
from datetime import UTC, datetime

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_service.adapters.ublox import AngleErrors, UudfEvent, parse_ublox, parse_uudf
from rayfix_service.fusion.measurements.report import Angle, ErrorModel
from rayfix_service.measuring.timestamps import utc_moment
from rayfix_service.wire import InvalidReportError
from rayfix_tables.errors import SettingsError
from tests.support.checkout import SHARED

NINE = '+UUDF:6C1DEBA5F60C,-53,8,2,0,37,"6C1DEBA09862","",1437347'
TEN = '+UUDF:F4CE5FC91A6A,-50,0,20,0,20,"CD84C98B935D","",238777,40871'


def line(tag: str, anchor: str, sequence: int | None = None, azimuth: int = 10, elevation: int = -5) -> str:
    end = "" if sequence is None else f",{sequence}"
    return f'+UUDF:{tag},-53,{azimuth},{elevation},0,37,"{anchor}","",1437347{end}'


def test_nine_fields():
    assert parse_uudf(NINE) == UudfEvent(
        tag="6C1DEBA5F60C",
        rssi=-53,
        azimuth=8,
        elevation=2,
        channel=37,
        anchor="6C1DEBA09862",
        timestamp_ms=1437347,
        sequence=None,
    )


def test_ten_fields_and_white_space():
    event = parse_uudf(f"\r\n {TEN} \r\n")
    assert (event.azimuth, event.elevation, event.anchor, event.sequence) == (0, 20, "CD84C98B935D", 40871)


def test_a_users_text_may_hold_commas():
    event = parse_uudf('+UUDF:6C1DEBA5F60C,-53,8,2,0,37,"6C1DEBA09862","48.1,7.8",1437347')
    assert event.timestamp_ms == 1437347


def test_real_samples():
    path = SHARED / "formats" / "ublox_uudf_lines.txt"
    if not path.is_file():
        pytest.skip("the folder ../shared/formats with real samples is not here")
    reports = parse_ublox(path.read_bytes())
    assert [adapted.report.target_id for adapted in reports] == ["6C1DEBA5F60C", "F4CE5FC91A6A", "6C1DEBA4241B"]
    angles = [adapted.report.measurements[0] for adapted in reports]
    assert [angle.station_id for angle in angles] == ["6C1DEBA09862", "CD84C98B935D", "CCF9579B21AE"]
    azimuths = [math.degrees(angle.azimuth) for angle in angles if isinstance(angle, Angle)]
    assert azimuths == pytest.approx([-8, 0, -26], abs=1e-9)


@settings(deadline=None)
@given(st.integers(-90, 90), st.integers(-90, 90))
def test_right_of_the_boresight_is_a_negative_azimuth(azimuth: int, elevation: int):
    (adapted,) = parse_ublox(line("tag", "anchor", azimuth=azimuth, elevation=elevation), stations={"anchor": "bs1"})
    (angle,) = adapted.report.measurements
    assert isinstance(angle, Angle)
    assert (angle.station_id, angle.frame) == ("bs1", "lcs")
    assert angle.zenith is not None
    assert math.degrees(-angle.azimuth) == pytest.approx(azimuth, abs=1e-9)
    assert 90 - math.degrees(angle.zenith) == pytest.approx(elevation, abs=1e-9)
    assert (angle.azimuth_stdev, angle.zenith_stdev) == (math.radians(10), math.radians(10))
    assert angle.error_model == ErrorModel(tail_share=0.2, tail_scale=3.0)


def stations(text: str) -> list[tuple[str | None, list[str], list[int]]]:
    """Tell what the lines are joined to: tag, stations and line numbers of each report."""
    return [
        (
            adapted.report.target_id,
            [m.station_id for m in adapted.report.measurements],
            [int(source[1]) for source in adapted.sources],
        )
        for adapted in parse_ublox(text)
    ]


def test_lines_are_joined_by_tag_and_sequence_number():
    text = "\n".join(
        [
            line("t1", "a", 1),
            line("t2", "a", 1),
            "+STARTUP",
            line("t1", "b", 2),
            line("t1", "b", 1),
            line("t1", "a", 2),
            "",
            line("t2", "c", 1),
        ]
    )
    assert stations(text) == [
        ("t1", ["a", "b"], [0, 4]),
        ("t2", ["a", "c"], [1, 7]),
        ("t1", ["b", "a"], [3, 5]),
    ]


def test_without_sequence_number_an_anchor_that_speaks_again_begins_anew():
    text = "\n".join([line("t", "a"), line("t", "b"), line("u", "a"), line("t", "b"), line("t", "a"), line("t", "a")])
    assert stations(text) == [
        ("t", ["a", "b"], [0, 1]),
        ("u", ["a"], [2]),
        ("t", ["b", "a"], [3, 4]),
        ("t", ["a"], [5]),
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("+UUDF:a,b", "line 1 has 2 fields; give 9, or 10 with the sequence number"),
        (f"\n{line('t', 'a')},1,2", "line 2 has 11 fields"),
        (NINE.replace(",8,", ",91,"), "line 1 has angle_azimuth '91'; give an integer from -90 to 90"),
        (NINE.replace(",2,", ",up,"), "line 1 has angle_elevation 'up'; give an integer from -90 to 90"),
        (NINE.replace(",37,", ",40,"), "line 1 has channel '40'"),
        (NINE.replace("1437347", "-1"), "line 1 has timestamp_ms '-1'"),
        (TEN.replace("40871", "x"), "line 1 has sequence number 'x'"),
        (line("", "a"), "line 1 has instance id ''; give 1 to 128 characters"),
        (line("t", ""), "line 1 has anchor id ''; give 1 to 128 characters"),
        ("OK\n+STARTUP\n", r"no line holds \+UUDF:; give at least one"),
    ],
)
def test_refusals_name_the_line_and_the_remedy(text: str, words: str):
    with pytest.raises(InvalidReportError, match=words):
        parse_ublox(text)


def test_a_line_of_another_kind_is_refused():
    with pytest.raises(InvalidReportError, match="the line is 'OK'; give a line that begins with"):
        parse_uudf("OK")


def test_too_many_reports_are_refused():
    with pytest.raises(InvalidReportError, match="more than 1000 reports; give at most 1000"):
        parse_ublox("\n".join([line("t", "a")] * 1001))


def test_events_in_a_log_are_found_in_their_lines():
    """What stands before them is passed over; other lines are counted in the first report."""
    plain = [line("t", "a"), line("t", "b"), line("t", "c"), line("t", "a")]
    log = [f"12:00:01 -> {text}" for text in plain]
    found = parse_ublox("\n".join(["+STARTUP", "", log[0], "OK", *log[1:3], f"[INFO] {plain[3]}", "OK"]))
    expected = parse_ublox("\n".join(plain))
    assert [adapted.report for adapted in found] == [adapted.report for adapted in expected]
    assert found[0].sources == (("lines", 2), ("lines", 4), ("lines", 5))
    assert [(skip.path, skip.reason) for skip in found[0].skipped] == [
        (("lines", 0), "this line and 2 more lines hold no +UUDF:")
    ]
    assert [adapted.skipped for adapted in (*found[1:], *expected)] == [()] * 3


def test_errors_of_angles_can_be_set():
    errors = AngleErrors(stdev_deg=4.0, tail_share=0.0, tail_scale=1.0)
    (adapted,) = parse_ublox(line("t", "a"), errors=errors)
    (angle,) = adapted.report.measurements
    assert isinstance(angle, Angle)
    assert (angle.azimuth_stdev, angle.error_model) == (math.radians(4), ErrorModel())


@pytest.mark.parametrize(
    "wrong", [{"stdev_deg": 0.0}, {"stdev_deg": math.nan}, {"tail_share": 1.0}, {"tail_scale": 0.5}]
)
def test_errors_out_of_range_are_refused(wrong: dict[str, float]):
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        AngleErrors(**wrong)


def test_a_line_that_is_not_valid_costs_itself():
    text = "\n".join([line("t", "a", 1), "+UUDF:cut off", line("t", "b", 1), NINE.replace(",8,", ",91,"), "+STARTUP"])
    first, *more = parse_ublox(text)
    assert [m.station_id for m in first.report.measurements] == ["a", "b"]
    assert not more
    assert [(skip.path, skip.reason) for skip in first.skipped] == [
        (("lines", 1), "left out: line 2 has 1 fields; give 9, or 10 with the sequence number"),
        (("lines", 3), "left out: line 4 has angle_azimuth '91'; give an integer from -90 to 90"),
        (("lines", 4), "this line holds no +UUDF:"),
    ]


def test_many_lines_that_are_not_valid_are_counted():
    (adapted,) = parse_ublox("\n".join(["+UUDF:cut off"] * 50 + [line("t", "a")]))
    assert [skip.path[1] for skip in adapted.skipped] == list(range(21))
    assert adapted.skipped[-1].reason == "this and 29 later lines are not valid either"
    with pytest.raises(InvalidReportError) as refused:
        parse_ublox("\n".join(["+UUDF:cut off"] * 50))
    assert (len(refused.value.problems), refused.value.more) == (20, 30)


def timestamps(text: str, received: datetime | None = None) -> list[str | None]:
    return [adapted.report.timestamp for adapted in parse_ublox(text, received=received)]


def test_the_time_of_a_log_is_that_of_the_report():
    assert timestamps(f"2026-11-30 10:00:00,250 rx {line('t', 'a', 1)}") == ["2026-11-30T10:00:00.250000+00:00"]
    assert timestamps(f"[2026-11-30T10:00:00+01:00] {line('t', 'a', 1)}") == ["2026-11-30T10:00:00+01:00"]
    both = f"2026-11-30T10:00:02Z {line('t', 'a', 1)}\n2026-11-30T10:00:01Z {line('t', 'b', 1)}"
    assert timestamps(both) == ["2026-11-30T10:00:01+00:00"]
    assert timestamps(f"2026-99-30 10:00:00 {line('t', 'a', 1)}\n12:00 {line('t', 'a', 2)}") == [None, None]


def test_without_a_log_times_are_counted_back_from_the_receipt_by_the_anchors_clocks():
    """The clocks of the anchors differ; the last line of each came now."""
    sent = [("a", 1, 1000), ("b", 1, 500_020), ("a", 2, 1100), ("b", 2, 500_120), ("a", 3, 1250)]
    text = "\n".join(line("t", anchor, number).replace("1437347", str(ms)) for anchor, number, ms in sent)
    now = datetime(2026, 11, 30, 10, 0, 1, tzinfo=UTC)
    times = [datetime.fromisoformat(str(time)) for time in timestamps(text, now)]
    assert [round((now - time).total_seconds(), 6) for time in times] == [0.25, 0.15, 0.0]
    assert timestamps(text) == [None, None, None]


@pytest.mark.parametrize(("first", "last"), [(0, 2**64), (2**63, 0), (500, 400), (0, 86_400_001)])
def test_clocks_that_cannot_be_right_give_no_time(first: int, last: int):
    """An anchor that started anew, and differences that no datetime can hold."""
    text = "\n".join(line("t", "a", n).replace("1437347", str(ms)) for n, ms in enumerate((first, last)))
    now = datetime(2026, 11, 30, tzinfo=UTC)
    assert timestamps(text, now) == [None, now.isoformat()]


@pytest.mark.parametrize("text", ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-12:00"])
def test_times_at_the_ends_of_the_calendar_can_be_followed(text: str):
    (timestamp,) = timestamps(f"{text} {line('t', 'a', 1)}")
    assert timestamp is not None
    assert utc_moment(timestamp).tzinfo is UTC
