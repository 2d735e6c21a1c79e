"""Small random tables."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.tables.random_tables import Content, random_content


@pytest.fixture(scope="session")
def make_content() -> Callable[..., Content]:
    """Return the function that fills a table with random numbers."""
    return random_content


@pytest.fixture
def small_table_path(tmp_path: Path) -> Path:
    """Path of a table with two stations of two levels; the test may damage it."""
    path = tmp_path / "small.h5"
    random_content(1).write(path)
    return path
