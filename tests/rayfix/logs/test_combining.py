"""Packets of a target within a window become one report."""

import math
from collections.abc import Iterator

import pytest

from rayfix.logs.combining import Combine, joined
from rayfix.logs.entries import Entry, Place, Problem
from rayfix_service.fusion.measurements.report import Angle, Height, Measurement, Range, Report


def entry(
    n: int, seconds: float, *measured: Measurement, target: str | None = "a", height: float | None = None
) -> Entry:
    minutes, rest = divmod(seconds, 60.0)
    report = Report(
        measurements=measured,
        target_id=target,
        timestamp=f"2026-01-31T10:{int(minutes):02d}:{rest:09.6f}Z",
        height=None if height is None else Height(z=height, stdev=0.1),
    )
    return Entry(place=Place("log", n), report=report)


def angle(azimuth_deg: float, station: str = "s", zenith_deg: float | None = None) -> Angle:
    zenith = None if zenith_deg is None else math.radians(zenith_deg)
    return Angle(
        station_id=station,
        azimuth=math.radians(azimuth_deg),
        azimuth_stdev=0.1,
        zenith=zenith,
        zenith_stdev=None if zenith is None else 0.2,
    )


def length(metres: float, stdev: float = 0.1) -> Range:
    return Range(station_id="s", path_length=metres, stdev=stdev)


def reports(entries: list[Entry | Problem], combine: Combine = "median", window: float = 1.0) -> list[Report]:
    found = list(joined(iter(entries), window, combine))
    assert all(isinstance(each, Entry) for each in found)
    return [each.report for each in found if isinstance(each, Entry) and isinstance(each.report, Report)]


def test_the_median_and_the_mean_of_ranges() -> None:
    packets: list[Entry | Problem] = [
        entry(n, 0.2 * n, length(metres, stdev))
        for n, (metres, stdev) in enumerate([(5.0, 0.1), (5.2, 0.3), (9.0, 0.2)])
    ]
    (middle,) = reports(packets)
    assert middle.measurements == (length(5.2, 0.2),)
    assert middle.timestamp == "2026-01-31T10:00:00.200000Z"
    (mean,) = reports(packets, "mean")
    assert isinstance(mean.measurements[0], Range)
    assert mean.measurements[0].path_length == pytest.approx(6.4, abs=1e-12)
    (all_of_them,) = reports(packets, "none")
    assert all_of_them.measurements == (length(5.0, 0.1), length(5.2, 0.3), length(9.0, 0.2))


@pytest.mark.parametrize("combine", ["median", "mean"])
def test_azimuths_on_both_sides_of_180_deg(combine: Combine) -> None:
    (report,) = reports([entry(n, 0.1 * n, angle(a)) for n, a in enumerate((176.0, -178.0, -179.0))], combine)
    (found,) = report.measurements
    assert isinstance(found, Angle)
    # 176, 181 and 182 deg
    assert math.degrees(found.azimuth) % 360.0 == pytest.approx(181.0 if combine == "median" else 539.0 / 3, abs=1e-9)


def test_windows_are_of_targets_and_follow_each_other() -> None:
    packets: list[Entry | Problem] = [
        entry(1, 0.0, length(1.0), height=1.5),
        entry(2, 0.1, length(7.0), target="b"),
        entry(3, 0.9, length(3.0)),
        entry(4, 1.0, length(5.0)),
        entry(5, 30.0, length(8.0), target="b"),
    ]
    found = reports(packets)
    assert [(r.target_id, [m.path_length for m in r.measurements if isinstance(m, Range)]) for r in found] == [
        ("a", [2.0]),
        ("b", [7.0]),
        ("a", [5.0]),
        ("b", [8.0]),
    ]
    assert found[0].height == Height(z=1.5, stdev=0.1)


def test_kinds_stations_and_paths_stay_apart() -> None:
    one = (angle(1.0), angle(50.0), angle(3.0, "t"), length(4.0), angle(2.0, zenith_deg=80.0))
    other = (angle(3.0), angle(60.0), length(6.0))
    (report,) = reports([entry(1, 0.0, *one), entry(2, 0.1, *other)], "mean")
    found = [
        (m.station_id, round(math.degrees(m.azimuth), 9)) if isinstance(m, Angle) else getattr(m, "path_length", None)
        for m in report.measurements
    ]
    assert found == [("s", 2.0), ("s", 55.0), ("t", 3.0), 5.0, ("s", 2.0)]


def test_a_report_without_a_time_is_a_problem() -> None:
    def entries() -> Iterator[Entry | Problem]:
        yield Entry(place=Place("log", 1), report=Report(measurements=(length(1.0),), target_id="a"))
        yield Entry(place=Place("log", 2), report=b"{")

    problems = list(joined(entries(), 1.0, "median"))
    assert all(isinstance(each, Problem) for each in problems)
    assert "timestamp" in problems[0].text  # type: ignore[union-attr]


def test_a_log_of_many_targets_keeps_few_windows_open() -> None:
    given = 0

    def entries() -> Iterator[Entry | Problem]:
        nonlocal given
        for n in range(3000):
            given += 1
            yield entry(n, 0.5 * n, length(1.0), target=f"t{n}")

    stream = joined(entries(), 1.0, "median")
    next(stream)
    assert given < 40
    assert sum(1 for _ in stream) == 2999
