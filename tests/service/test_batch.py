"""Many reports in one call, in this process and in others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rayfix_service.batch import locate_batch
from rayfix_service.fusion.measurements.report import Angle, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.locator import Locator
from rayfix_tables.errors import ReportError, TableError
from rayfix_tables.geometry.angles import angles_of
from rayfix_tables.table import Table


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> Locator:
    return Locator(Table.open(hall_table_path))


def reports(locator: Locator, count: int) -> list[Report]:
    """Angles and lengths of direct paths, some to two places; every seventh report names a station that is none."""
    rng = np.random.default_rng(4)
    stations = locator.table.site.stations
    made = []
    for n in range(count):
        measurements: list[Angle | Range] = []
        place = rng.uniform([1.0, 2.0, 0.8], [7.0, 16.0, 1.6])
        for k, station in enumerate(stations[:3]):
            apart = place + (5.0 * (k == 2) if n % 3 else 0.0) - np.array(station.position)
            azimuth, zenith = (float(angle) for angle in angles_of(apart))
            name = station.id if n % 7 or k else f"station {n}"
            measurements += [
                Angle(station_id=name, azimuth=azimuth, zenith=zenith, azimuth_stdev=0.02, zenith_stdev=0.02),
                Range(station_id=name, path_length=float(np.linalg.norm(apart)), stdev=0.5),
            ]
        made.append(Report(measurements=tuple(measurements), target_id=str(n)))
    return made


def one_by_one(locator: Locator, report: Report) -> Fix | ReportError:
    try:
        return locator.locate(report)
    except ReportError as error:
        return error


@pytest.mark.parametrize(("count", "jobs"), [(0, -1), (1, -1), (50, 1), (150, 2)])
def test_a_batch_is_its_reports_one_by_one(locator: Locator, count: int, jobs: int) -> None:
    given = reports(locator, count)
    answers = locate_batch(locator, given, jobs=jobs)
    assert len(answers) == count
    for n, (answer, report) in enumerate(zip(answers, given, strict=True)):
        expected = one_by_one(locator, report)
        if isinstance(expected, ReportError):
            assert isinstance(answer, ReportError)
            assert f"station {n}" in str(answer)
            assert (str(answer), answer.path) == (str(expected), expected.path)
            continue
        assert isinstance(answer, Fix)
        assert answer.target_id == str(n)
        assert (answer.status, answer.outcomes, answer.log_evidence) == (
            expected.status,
            expected.outcomes,
            expected.log_evidence,
        )
        for one, other in zip(answer.candidates, expected.candidates, strict=True):
            np.testing.assert_array_equal(one.position, other.position)
            np.testing.assert_array_equal(one.covariance, other.covariance)
    assert count < 50 or len({answer.status for answer in answers if isinstance(answer, Fix)}) > 1


def test_a_table_that_was_replaced_is_not_mixed_with_the_new_one(locator: Locator) -> None:
    former = Locator(replace(locator.table, table_id="of the file that was there before"))
    given = reports(locator, 150)
    with pytest.raises(TableError, match="another table since it was opened"):
        locate_batch(former, given, jobs=2)
    assert len(locate_batch(former, given, jobs=1)) == 150
