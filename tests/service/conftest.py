"""A service that several modules ask."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.running_app import RunningApp


@pytest.fixture(scope="session")
def hall_app(hall_table_path: Path) -> Iterator[RunningApp]:
    """Return the application of the hall's small table, as it is without settings, ready to locate."""
    with RunningApp(hall_table_path) as app:
        yield app
