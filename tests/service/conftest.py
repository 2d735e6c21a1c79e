"""What several modules ask: a service, and tables by hand."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rayfix_tables.table import Table
from tests.support.running.running_app import RunningApp
from tests.support.tables.hand_tables import MakeTable, Tube, table_of


@pytest.fixture(scope="session")
def hall_app(hall_table_path: Path) -> Iterator[RunningApp]:
    """Return the application of the hall's small table, as it is without settings, ready to locate."""
    with RunningApp(hall_table_path) as app:
        yield app


@pytest.fixture
def make_table(tmp_path: Path) -> MakeTable:
    """Return the function that makes a table of tubes."""

    def make(*tubes: Tube, **options: Any) -> Table:
        return table_of(tmp_path / f"{len(list(tmp_path.iterdir()))}.h5", *tubes, **options)

    return make
