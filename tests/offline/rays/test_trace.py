"""Rays of a station: as many as its finest window needs, and for the path prior's map no fewer than that needs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.rays.trace import (
    StationTrace,
    prior_spacing,
    trace_station,
)
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import Twin, prepare_twin


@pytest.fixture
def trace(write_site: Callable[..., Path], tmp_path: Path) -> Callable[..., tuple[StationTrace, Twin]]:
    """Return a function that traces the cluttered room's station for a window [deg]."""

    def run(window: float) -> tuple[StationTrace, Twin]:
        path = write_site(tmp_path, table={"windows_deg": [window]})
        site = read_site(path)
        twin = prepare_twin(site, tmp_path)
        return trace_station(site.stations[0], site, twin), twin

    return run


@pytest.mark.parametrize("window", [1.25, 10.0])
def test_cells_have_the_rays_that_their_window_needs(
    trace: Callable[..., tuple[StationTrace, Twin]], window: float
) -> None:
    level = trace(window)[0].finest
    assert level.ray_spacing == pytest.approx(np.deg2rad(window) / RaySettings.rays_per_window)
    assert level.rays.solid_angle.sum() == pytest.approx(4.0 * np.pi)
    assert len(level.rays) == pytest.approx(4.0 * np.pi / level.ray_spacing**2, rel=0.1)


def test_wide_windows_do_not_coarsen_the_path_prior(trace: Callable[..., tuple[StationTrace, Twin]]) -> None:
    """What a station reaches does not depend on the windows of its table."""
    fine, wide = (np.array(trace(window)[0].coverage) for window in (1.25, 20.0))
    np.testing.assert_allclose(wide, fine, atol=0.01)
    assert 0.5 < fine[0] < fine[1] <= 1.0


def test_rays_for_the_path_prior_meet_every_voxel(trace: Callable[..., tuple[StationTrace, Twin]]) -> None:
    """The room's diagonal is 7.1 m, the map's voxels measure 0.2 m."""
    _, twin = trace(10.0)
    spacing = prior_spacing(twin)
    assert spacing * np.sqrt(4.0**2 + 5.0**2 + 3.0**2) == pytest.approx(RaySettings.prior_rays * 0.2)
    assert RaySettings.prior_spacing < spacing < np.deg2rad(1.2)
