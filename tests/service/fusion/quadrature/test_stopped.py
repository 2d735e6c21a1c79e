"""An integration that is stopped ends before the next factor is evaluated."""

from pathlib import Path

import pytest

from rayfix_service.fusion.measurements.report import Range, Report
from rayfix_service.fusion.quadrature import grid
from rayfix_service.fusion.stopping import FixStoppedError, Stop
from rayfix_service.locator import Locator
from rayfix_tables.table import Table


def test_it_ends_between_factors(hall_table_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All factors at all points took up to 95 ms on the event loop of a busy service."""
    locator = Locator(Table.open(hall_table_path))
    stop, evaluate, count = Stop(), grid.evaluate, 0

    def evaluate_and_stop(*arguments: object) -> None:
        nonlocal count
        count += 1
        evaluate(*arguments)
        stop.set()

    monkeypatch.setattr(grid, "evaluate", evaluate_and_stop)
    ranges = tuple(Range(station_id=each.id, path_length=7.0, stdev=1.0) for each in locator.table.site.stations)
    with pytest.raises(FixStoppedError):
        locator.locate(Report(measurements=ranges), stop=stop)
    assert count == 1
