"""Fixtures that more than one test module uses."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from rayfix.example.files import write_example
from rayfix_offline.build import build_table
from rayfix_tables.gaussians.compilation import watch_compilation
from tests.support.checkout import SHARED

# A shared machine may stall for longer than an example may take by default.
settings.register_profile(
    "shared machine", parent=settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("shared machine")

# Several processes run the tests, and compile kernels at their first calls.
watch_compilation()


@pytest.fixture(scope="session", autouse=True)
def floating_point_as_compiled() -> Iterator[None]:
    """Let NumPy divide by zero and overflow without a warning where kernels run as Python (NUMBA_DISABLE_JIT).

    Compiled kernels do so, too. Other warnings remain errors.
    """
    with np.errstate(
        **dict.fromkeys(("divide", "over", "under", "invalid"), "ignore") if numba.config.DISABLE_JIT else {}
    ):
        yield


@pytest.fixture(scope="session")
def hall_site_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Site file of the bundled hall with wide windows, so that its table is built in seconds. Do not change it."""
    folder = tmp_path_factory.mktemp("hall")
    site = write_example(folder, windows_deg=(2.5, 10.0))
    text = site.read_text(encoding="utf-8").replace("max_reflections = 3", "max_reflections = 2")
    site.write_text(text, encoding="utf-8")
    return site


@pytest.fixture(scope="session")
def hall_table_path(hall_site_path: Path) -> Path:
    """Return the path of a small table of the bundled hall. Do not change it; copy it."""
    path = hall_site_path.parent / "hall.h5"
    build_table(hall_site_path, path)
    return path


@pytest.fixture
def hall_table_copy(hall_table_path: Path, tmp_path: Path) -> Path:
    """Return the path of a copy of the small table that the test may damage."""
    return Path(shutil.copy(hall_table_path, tmp_path / "copy.h5"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real scenes and measurements; the test skips where it is missing."""
    if not (SHARED / "data").is_dir():
        pytest.skip("the folder ../shared/data with real scenes is not here")
    return SHARED / "data"
