"""A third party's industrial hall: 14 x 21 m, 25 objects, walls of 10 m, no roof."""

from pathlib import Path

import numpy as np
import pytest

from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_offline.build import build_table
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import Twin, prepare_twin, refuse_errors
from rayfix_tables.table import Table
from tests.support.scenes.sites import stations_text

POSITIONS = [(-4.3, -9.9, 4.5), (6.5, -9.5, 4.5), (-4.3, 0.0, 5.0), (6.5, 0.0, 5.0), (-6.5, 9.5, 4.5), (6.5, 9.5, 4.0)]
IN_A_RACK = (-6.0, 0.0, 4.0)
"""The tall racks along the wall at x = -7 are solid in this mesh."""

SITE = """
[site]
name = "warehouse"
scene = "{scene}"
[propagation]
max_reflections = 1
max_path_length_m = 40.0
[table]
windows_deg = [7.5]
"""


@pytest.fixture(scope="module")
def site_path(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Site file with six stations under the walls' tops."""
    stations = stations_text({f"bs{n}": position for n, position in enumerate(POSITIONS, 1)})
    path = tmp_path_factory.mktemp("warehouse") / "site.toml"
    path.write_text(SITE.format(scene=shared_data / "warehouse" / "warehouse_collision.ply") + stations)
    return path


@pytest.fixture(scope="module")
def site(site_path: Path) -> SiteFile:
    """Read the site."""
    return read_site(site_path)


@pytest.fixture(scope="module")
def twin(site: SiteFile, site_path: Path) -> Twin:
    """Its twin."""
    return prepare_twin(site, site_path.parent)


def test_findings(twin: Twin) -> None:
    """It has no roof, so nothing encloses it; some objects are open. Nothing stops the build."""
    refuse_errors(twin)
    assert not twin.closed
    assert len(twin.scene.faces) == 1600
    np.testing.assert_allclose(np.diff(twin.scene.bounds, axis=0)[0], (13.98, 20.91, 10.11), rtol=0, atol=0.01)
    (warning,) = [finding.message for finding in twin.findings]
    assert warning.startswith("open parts without an inside: warehouse_collision")
    assert 300 < len(twin.planes) < 800


def test_free_space(twin: Twin) -> None:
    """All solids are closed but three small ones of the forklift; they take up 320 of 2,955 m3."""
    space = twin.free_space
    assert space.volume == pytest.approx(2955.0 - 320.0, rel=0.02)
    assert space.contains(np.array(POSITIONS)).all()
    assert not space.contains(np.array(IN_A_RACK))


def test_a_station_in_a_rack_is_refused(site: SiteFile, site_path: Path) -> None:
    station = site.stations[0].model_copy(update={"id": "bs7", "position_m": IN_A_RACK})
    twin = prepare_twin(site.model_copy(update={"stations": (*site.stations, station)}), site_path.parent)
    errors = [finding.message for finding in twin.findings if finding.severity == "error"]
    assert errors == [
        "station 'bs7' at (-6, 0, 4) m lies inside the solid 'warehouse_collision.ply #1'; move it into free space"
    ]


def test_the_build(site_path: Path, tmp_path: Path) -> None:
    summary = build_table(site_path, tmp_path / "t.h5")
    table = Table.open(tmp_path / "t.h5")
    table.verify()
    assert [station.id for station in table.site.stations] == [f"bs{n}" for n in range(1, 7)]
    for part in summary.stations:
        assert part.num_filled_cells == part.num_cells
        assert 0.0 < part.lost_ray_share < 0.5  # out of the roof that is not there
        assert 0.1 < part.coverage[0] < part.coverage[1] <= 1.0
    low, high = table.scene.vertices.min(axis=0), table.scene.vertices.max(axis=0)
    for part in table.parts.values():
        places = part.levels[0].mixture.x_mean
        assert np.all((places > low - 0.1) & (places < high + 0.1))


def test_every_path_lies_in_a_cell_that_knows_it(site_path: Path, tmp_path: Path, twin: Twin) -> None:
    """For paths of the image method, the cell of the angle holds a component near the place, with about that length."""
    build_table(site_path, tmp_path / "t.h5")
    table = Table.open(tmp_path / "t.h5")
    solver = ForwardSolver.from_mesh(twin.scene.vertices, twin.scene.faces, max_reflections=1, max_path_length=39.0)
    rng = np.random.default_rng(0)
    checked = 0
    for _ in range(12):
        place = rng.uniform((-6, -9, 0.5), (6, 9, 2.0))
        if not twin.free_space.contains(place):
            continue
        for station in table.site.stations:
            (level,) = table.levels(station.id)
            paths = solver.paths(station.position, place)
            for k in range(min(len(paths), 2)):
                cell = level.cell(int(level.grid.nearest(paths.azimuth[k], paths.zenith[k])))
                off = np.hypot(np.linalg.norm(cell.x_mean - place, axis=1), cell.u_mean[:, 0] - paths.path_length[k])
                width = np.sqrt(cell.u_cov[:, 0]) + 2.0 * level.window * cell.u_mean[:, 0]
                assert (off / width).min() < 2.0
                checked += 1
    assert checked > 40
