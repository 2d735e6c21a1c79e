"""Times of arrival beside measured paths: the same as paths of a time alone, and what is refused."""

import pytest

from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table
from tests.support.tables.mirrored_paths import AT, seen
from tests.support.tables.open_room import mirrored_room_table


@pytest.fixture(scope="module")
def mirrored(tmp_path_factory: pytest.TempPathFactory) -> Table:
    return mirrored_room_table(tmp_path_factory.mktemp("room"))


OFFSET = 412.0


def parts(name: str, number: int = 0) -> tuple[dict[str, object], dict[str, object], dict[str, object]]:
    """Return a path of a station as a toa, an aoa and a path of the time alone."""
    row = seen(name, "toa_m", OFFSET)[number]
    angles = {key: value for key, value in row.items() if key.startswith(("azimuth", "zenith"))}
    return (
        {"type": "toa", "station_id": name, "range_m": row["toa_m"], "stdev_m": 0.1},
        {"type": "aoa", "station_id": name, **angles},
        {"type": "path", "station_id": name, "toa_m": row["toa_m"], "stdev_m": 0.1},
    )


def located(table: Table, *rows: dict[str, object]) -> Fix:
    return Locator(table).locate({"measurements": list(rows)})


def test_a_time_of_another_station_is_a_path_of_that_length(mirrored: Table) -> None:
    first = seen("a", "toa_m", OFFSET)[0]
    time, angle, path = parts("b")
    beside, as_path = located(mirrored, first, time), located(mirrored, first, path)
    assert beside.log_evidence == pytest.approx(as_path.log_evidence, abs=1e-9)
    assert beside.position == pytest.approx(as_path.position)
    assert [outcome.used for outcome in beside.outcomes] == [True, True]
    # With the angle of that station it is one path of both, not two.
    whole = located(mirrored, first, seen("b", "toa_m", OFFSET)[0])
    with_angle = located(mirrored, angle, first, time)
    assert with_angle.log_evidence == pytest.approx(whole.log_evidence, abs=1e-9)
    assert [outcome.used for outcome in with_angle.outcomes] == [True, True, True]


def test_times_narrow_what_one_station_leaves_open(mirrored: Table) -> None:
    """One path of an unknown clock leaves the distance open; times of three other stations do not."""
    first = seen("a", "toa_m", OFFSET)[0]
    alone = located(mirrored, first)
    fix = located(mirrored, first, *(parts(name)[0] for name in ("b", "c", "d")))
    assert fix.position is not None
    assert alone.regions is not None
    assert fix.regions is not None
    assert sum((fix.position - AT) ** 2) < 0.15**2
    assert fix.regions.accuracies(0.9).horizontal_radius < 0.5 * alone.regions.accuracies(0.9).horizontal_radius


def test_a_time_of_the_same_station_may_be_of_a_path_that_it_reports(mirrored: Table) -> None:
    """It is no further path of the set, which would have to be another one."""
    rows = seen("a", "toa_m", OFFSET)
    again = {**parts("a")[0], "range_m": float(str(rows[0]["toa_m"])) + 0.02}
    fix = located(mirrored, *rows, again)
    assert fix.position is not None
    assert sum((fix.position - AT) ** 2) < 0.1**2
    assert all((outcome.outlier_probability or 0.0) < 0.1 for outcome in fix.outcomes)


def test_a_time_that_shares_its_clock_with_nothing_is_not_used(mirrored: Table) -> None:
    rows = seen("a", "range_m")
    time, angle, _ = parts("b")
    fix, without = located(mirrored, *rows, angle, time), located(mirrored, *rows, angle)
    assert [outcome.used for outcome in fix.outcomes] == [True, True, True, False]
    assert "UE's clock is unknown" in (fix.outcomes[3].reason or "")
    assert fix.log_evidence == pytest.approx(without.log_evidence, abs=1e-9)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ([{"error_model": "heavy_tailed"}], "heavy-tailed errors beside"),
        ([{"los_probability": 0.9}], "los_probability beside"),
        ([{}, {"range_m": 500.0}], "one of several times"),
    ],
)
def test_times_that_are_no_path_are_refused(mirrored: Table, extra: list[dict[str, object]], message: str) -> None:
    times = [parts("b")[0] | change for change in extra]
    with pytest.raises(ReportError, match=message) as caught:
        located(mirrored, seen("a", "toa_m", OFFSET)[0], *times)
    assert "path with toa_m" in str(caught.value)
    assert caught.value.path == ("measurements", 1)


def test_what_belongs_together_must_be_plain(mirrored: Table) -> None:
    first, (time, angle, _) = seen("a", "toa_m", OFFSET)[0], parts("b")
    with pytest.raises(ReportError, match="give angle and time as a path with toa_m"):
        located(mirrored, first, time, angle, {**angle, "azimuth_deg": 3.0})
    difference = {
        "type": "tdoa",
        "station_id": "b",
        "reference_station_id": "c",
        "range_difference_m": 0.5,
        "stdev_m": 0.1,
    }
    with pytest.raises(ReportError, match="give the times of arrival that it is of, as toa"):
        located(mirrored, first, difference)
