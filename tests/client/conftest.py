"""A real service for the clients."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.running.server_process import start_rayfix_serve


@pytest.fixture(scope="session")
def service_url(hall_table_path: Path) -> Iterator[str]:
    """Address of a service in a process of its own, ready to locate."""
    with start_rayfix_serve(hall_table_path) as server:
        yield server.url
