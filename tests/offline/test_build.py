"""The whole offline job: what it makes, that it makes the same again, and what it leaves when it is stopped."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from rayfix_offline.build import build_table
from rayfix_offline.fit import cells
from rayfix_offline.fit.settings import TubeFit
from rayfix_offline.fit.tubes import Fitted, fit_tubes
from rayfix_offline.rays.trace import LevelRays, level_grid
from rayfix_tables.errors import SceneError, SiteError, TableError
from rayfix_tables.geometry.angles import direction, local_to_scene
from rayfix_tables.table import Table

WriteSite = Callable[..., Path]
TWO = [{"id": "bs1", "position_m": [3.6, 0.4, 2.6]}, {"id": "bs2", "position_m": [0.2, 4.8, 2.6]}]


@pytest.fixture(scope="module")
def site_path(tmp_path_factory: pytest.TempPathFactory, write_site: WriteSite) -> Path:
    """Site file of the cluttered room: two stations, two levels, one reflection. Do not change it."""
    return write_site(tmp_path_factory.mktemp("site"), stations=TWO, table={"windows_deg": [8.0, 25.0]})


@pytest.fixture(scope="module")
def table_path(site_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the room's table. Do not change it."""
    path = tmp_path_factory.mktemp("table") / "room.h5"
    build_table(site_path, path, jobs=1)
    return path


def content(path: Path) -> dict[str, bytes]:
    """Names and bytes of the files in a folder and below."""
    return {str(entry.relative_to(path)): entry.read_bytes() for entry in path.rglob("*") if entry.is_file()}


# What it makes


def test_the_table_is_whole(table_path: Path, site_path: Path) -> None:
    table = Table.open(table_path)
    table.verify()
    assert table.site.name == "room"
    assert [station.id for station in table.site.stations] == ["bs1", "bs2"]
    assert table.site.stations[1].position == (0.2, 4.8, 2.6)
    assert table.site.document["table"] == {"windows_deg": [8.0, 25.0], "fit": "tubes", "seed": 1}
    assert table.site.document["site"]["scene"] == "room.glb"
    assert len(table.scene.faces) == 36
    assert table.scene.free_space.volume == pytest.approx(60.0 - 0.8 * 1.2 * 1.8 - 1.0 * 1.3 * 0.2, rel=1e-9)
    for part in table.parts.values():
        assert [round(float(np.rad2deg(level.window)), 9) for level in part.levels] == [8.0, 25.0]
        assert part.lost_ray_share <= 1e-4  # few rays may pass between two walls
        assert 0.75 < part.coverage[0] < part.coverage[1] <= 1.0
        for level in part.levels:
            assert level.num_cells == level_grid(level.window).num_cells
            assert np.isfinite(level.cell_log_mass).all()
            assert np.diff(level.cell_offsets).min() >= 1
            points = np.concatenate([level.cell(i).x_mean for i in range(level.num_cells)])
            assert np.all((points > -0.05) & (points < np.array([4.05, 5.05, 3.05])))


def test_a_screen_of_glass_is_passed(tmp_path: Path, write_site: WriteSite) -> None:
    """Half of the room lies behind a screen; opaque, it hides it, and of glass it is a wall that paths pass."""
    scene = trimesh.Scene()
    for name, bounds in {"room": [(0, 0, 0), (4, 5, 3)], "screen": [(1.98, 0.0, 0.0), (2.02, 5.0, 3.0)]}.items():
        mesh = trimesh.creation.box(bounds=bounds)
        if name == "room":
            mesh.invert()
        mesh.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(name=name))
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    glass = {"screen": {"itu": "glass", "thickness_m": 0.04}}
    tables = {}
    for name, materials, propagation in (
        ("opaque", {}, {}),
        ("glass", glass, {}),
        ("no excess", glass, {"excess_length": False}),
    ):
        folder = tmp_path / name
        folder.mkdir()
        site = write_site(
            folder, scene=scene, table={"windows_deg": [15.0]}, materials=materials, propagation=propagation
        )
        build_table(site, folder / "t.h5", jobs=1)
        tables[name] = Table.open(folder / "t.h5")
    (opaque,), (part,), (plain,) = (tuple(table.parts.values()) for table in tables.values())
    assert (opaque.wall_coverage, opaque.cut_power_share) == ((), 0.0)
    assert opaque.coverage[-1] == pytest.approx(0.5, abs=0.02)
    assert part.coverage == pytest.approx((1.0, 1.0), abs=0.02)
    assert part.wall_coverage[:2] == pytest.approx((0.5, 1.0), abs=0.02)
    mixture = part.levels[0].mixture
    here = mixture.x_mean[:, 0] > 2.1  # the station is there
    assert np.all(opaque.levels[0].mixture.x_mean[:, 0] > 1.9)
    direct = mixture.num_reflections == 0
    assert set(mixture.num_walls[here & direct].tolist()) == {0}
    beyond = (mixture.x_mean[:, 0] < 1.8) & direct
    assert np.count_nonzero(beyond) > 20
    assert set(mixture.num_walls[beyond].tolist()) == {1}
    # Behind the screen measured lengths are longer by what the slab adds, which grows from normal to grazing incidence.
    lengths = []
    for each in (part, plain):
        tubes = each.levels[0].mixture
        behind = (tubes.x_mean[:, 0] < 1.8) & (tubes.num_reflections == 0)
        way = np.linalg.norm(tubes.x_mean[behind] - each.station.position, axis=1)
        lengths.append(float(np.mean(tubes.u_mean[behind, 0] - way)))
    assert 0.04 * (np.sqrt(6.31) - 1.0) < lengths[0] - lengths[1] < 0.04 * np.sqrt(5.31)
    # Another thickness is another part.
    site.write_text(site.read_text(encoding="utf-8").replace("0.04", "0.05"), encoding="utf-8")
    summary = build_table(site, tmp_path / "glass" / "t.h5", jobs=1)
    assert [station.origin for station in summary.stations] != ["kept"]


@pytest.mark.parametrize(("path_prior", "balances"), [("power", True), ("uniform", False), ("paper", False)])
def test_levels_are_balanced_where_the_paths_to_a_place_have_probabilities(
    tmp_path: Path, write_site: WriteSite, path_prior: str, balances: bool
) -> None:
    site_path = write_site(tmp_path, propagation={"path_prior": path_prior}, table={"windows_deg": [20.0]})
    build_table(site_path, tmp_path / "t.h5", jobs=1)
    (part,) = Table.open(tmp_path / "t.h5").parts.values()
    for level in part.levels:
        assert len(level.log_balance) == (level.num_components if balances else 0)
        assert not balances or 0.01 < np.abs(level.log_balance).max() < 2.1


def test_the_summary_says_what_is_in_the_table(site_path: Path, tmp_path: Path) -> None:
    summary = build_table(str(site_path), str(tmp_path / "t.h5"), jobs=1)
    table = Table.open(tmp_path / "t.h5")
    assert (summary.path, summary.table_id) == (tmp_path / "t.h5", table.table_id)
    assert summary.num_bytes == (tmp_path / "t.h5").stat().st_size
    assert 0.0 < summary.seconds < 60.0
    assert summary.warnings == ()
    for part, level_of in zip(summary.stations, table.parts.values(), strict=True):
        assert part.station_id == level_of.station.id
        assert part.num_components == sum(level.num_components for level in level_of.levels)
        assert part.num_cells == part.num_filled_cells == sum(level.num_cells for level in level_of.levels)
        assert (part.lost_ray_share, part.coverage) == (level_of.lost_ray_share, level_of.coverage)
    arrays = sum(part.num_bytes for part in summary.stations)
    assert 0.5 * summary.num_bytes < arrays < summary.num_bytes


def test_dropped_components_are_counted(site_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each cell of the finest level has a component that no covariance can be given."""

    def fit(centres: NDArray[np.float64], level: LevelRays, settings: TubeFit) -> Fitted:
        fitted = fit_tubes(centres, level, settings)
        return fitted._replace(dropped=np.ones_like(fitted.counts))

    monkeypatch.setattr(cells, "fit_tubes", fit)
    summary = build_table(site_path, tmp_path / "t.h5", jobs=1)
    counts = {s.station_id: s.num_dropped_components for s in summary.stations}
    assert counts == {s.station_id: s.num_finest_cells for s in summary.stations}
    for station_id, count in counts.items():
        told = f"{count} components of station '{station_id}' have no positive definite covariance and are dropped"
        assert any(told in warning for warning in summary.warnings)


def test_every_stage_counts_up_to_all_of_its_work(site_path: Path, tmp_path: Path) -> None:
    calls: list[tuple[str, int, int]] = []
    build_table(site_path, tmp_path / "t.h5", jobs=1, progress=lambda *call: calls.append(call))
    total = sum(level_grid(np.deg2rad(window)).num_cells for window in (8.0, 25.0)) * 2
    assert calls[0] == ("reading the scene", 0, 0)
    stages = list(dict.fromkeys(stage for stage, _, _ in calls[1:]))
    assert stages[-2:] == ["balancing", "writing"]
    for group in (set(stages[:-2]), {"balancing"}, {"writing"}):
        done = [count for stage, count, _ in calls if stage in group]
        (whole,) = {whole for stage, _, whole in calls[1:] if stage in group}
        assert done == sorted(done)
        assert len(set(done)) > 2  # it moves
        assert (done[0], done[-1]) == (0, whole)
        assert group & {"balancing", "writing"} or whole == total
    assert any("bs1" in stage for stage in stages)
    assert any("bs2" in stage for stage in stages)


# The same again


def test_the_number_of_jobs_does_not_matter(site_path: Path, table_path: Path, tmp_path: Path) -> None:
    expected = Table.open(table_path).table_id
    for jobs in (1, 2):
        assert build_table(site_path, tmp_path / f"{jobs}.h5", jobs=jobs).table_id == expected


def test_the_place_of_the_site_does_not_matter(table_path: Path, tmp_path: Path, write_site: WriteSite) -> None:
    path = write_site(tmp_path, stations=TWO, table={"windows_deg": [8.0, 25.0]})
    assert build_table(path, tmp_path / "other name.h5").table_id == Table.open(table_path).table_id


@pytest.mark.parametrize(
    "change",
    [
        {"table": {"windows_deg": [25.0], "seed": 2}},
        {"propagation": {"max_reflections": 0}},
        {"propagation": {"path_prior": "paper"}},
        {"propagation": {"reflection_loss_db": 7.0}},
        {"site": {"north_deg": 0.0}},
        {"stations": [{"id": "bs1", "position_m": [3.6, 0.4, 2.5]}]},
        {"stations": [{"id": "bs9", "position_m": [3.6, 0.4, 2.6]}]},
    ],
)
def test_another_site_is_another_table(tmp_path: Path, write_site: WriteSite, change: dict[str, Any]) -> None:
    first = write_site(tmp_path, table={"windows_deg": [25.0]})
    before = build_table(first, tmp_path / "a.h5", jobs=1).table_id
    second = write_site(tmp_path, **{"table": {"windows_deg": [25.0]}, **change})
    assert build_table(second, tmp_path / "b.h5", jobs=1).table_id != before


def test_another_seed_is_another_sample_of_the_same_cells(tmp_path: Path, write_site: WriteSite) -> None:
    levels = []
    for seed in (1, 2):
        table = {"windows_deg": [25.0], "seed": seed}
        path = write_site(tmp_path, table=table, propagation={"path_prior": "uniform", "max_reflections": 0})
        build_table(path, tmp_path / f"{seed}.h5", jobs=1)
        levels.append(Table.open(tmp_path / f"{seed}.h5").levels("bs1")[0])
    first, second = (level.cell_log_mass for level in levels)
    assert not np.array_equal(first, second)
    np.testing.assert_allclose(first, second, rtol=0, atol=0.15)


def test_a_station_does_not_depend_on_the_others(table_path: Path, tmp_path: Path, write_site: WriteSite) -> None:
    path = write_site(tmp_path, stations=TWO[1:], table={"windows_deg": [8.0, 25.0]})
    build_table(path, tmp_path / "alone.h5")
    alone, together = (Table.open(p).levels("bs2") for p in (tmp_path / "alone.h5", table_path))
    for mine, theirs in zip(alone, together, strict=True):
        np.testing.assert_array_equal(mine.cell_log_mass, theirs.cell_log_mass)
        np.testing.assert_array_equal(mine.mixture.x_mean, theirs.mixture.x_mean)


# Field of view


@pytest.mark.parametrize("opening_deg", [60.0, 200.0])
def test_cells_outside_the_field_of_view_are_not_built(
    tmp_path: Path, write_site: WriteSite, opening_deg: float
) -> None:
    """A cone around local +x, widened by one window, since a cell at its rim holds directions within."""
    orientation = [120.0, 20.0, 45.0]
    station = {**TWO[0], "orientation_deg": orientation, "field_of_view_deg": opening_deg}
    build_table(write_site(tmp_path, stations=[station], table={"windows_deg": [10.0]}), tmp_path / "t.h5", jobs=1)
    (level,) = Table.open(tmp_path / "t.h5").levels("bs1")
    a, b, c = np.deg2rad(orientation)
    axis = local_to_scene((float(a), float(b), float(c))) @ np.array([1.0, 0.0, 0.0])
    angle = np.rad2deg(np.arccos(direction(*level.grid.centres.T) @ axis))
    built = angle <= opening_deg / 2 + 10.0
    np.testing.assert_array_equal(np.isfinite(level.cell_log_mass), built)
    np.testing.assert_array_equal(np.diff(level.cell_offsets) > 0, built)
    assert 0.05 < built.mean() < 0.75


def test_a_cell_is_the_same_in_any_field_of_view(tmp_path: Path, write_site: WriteSite) -> None:
    levels = []
    for opening in (90.0, 360.0):
        station = {**TWO[0], "orientation_deg": [120.0, 20.0, 0.0], "field_of_view_deg": opening}
        path = write_site(tmp_path, stations=[station], table={"windows_deg": [15.0]})
        build_table(path, tmp_path / "t.h5", jobs=1)
        levels.append(Table.open(tmp_path / "t.h5").levels("bs1")[0])
    narrow, wide = levels
    chosen = np.flatnonzero(np.isfinite(narrow.cell_log_mass))
    assert 10 < len(chosen) < wide.num_cells / 2
    for cell in chosen:
        np.testing.assert_array_equal(narrow.cell(cell).x_mean, wide.cell(cell).x_mean)
        assert narrow.cell_log_mass[cell] == wide.cell_log_mass[cell]


# The fit of the paper


def test_em_and_tubes_agree_on_the_masses(tmp_path: Path, write_site: WriteSite) -> None:
    """A narrow field of view, so that a handful of cells is fitted."""
    station = {**TWO[0], "orientation_deg": [130.0, 20.0, 0.0], "field_of_view_deg": 1.0}
    levels = {}
    for fit in ("tubes", "em"):
        path = write_site(tmp_path, stations=[station], table={"windows_deg": [15.0], "fit": fit})
        build_table(path, tmp_path / f"{fit}.h5", jobs=1)
        levels[fit] = Table.open(tmp_path / f"{fit}.h5").levels("bs1")[0]
    tubes, em = levels["tubes"], levels["em"]
    np.testing.assert_allclose(em.cell_log_mass, tubes.cell_log_mass, rtol=0, atol=1e-12)
    chosen = np.flatnonzero(np.isfinite(em.cell_log_mass))
    assert 2 <= len(chosen) <= 8
    for cell in chosen:
        means = [np.exp(level.cell(cell).log_weight) @ level.cell(cell).x_mean for level in (tubes, em)]
        assert np.linalg.norm(means[0] - means[1]) < 0.2  # m; 3,000 points spread over 1 to 2 m


@pytest.mark.slow
def test_em_does_not_depend_on_the_number_of_processes(tmp_path: Path, write_site: WriteSite) -> None:
    station = {**TWO[0], "orientation_deg": [130.0, 20.0, 0.0], "field_of_view_deg": 1.0}
    path = write_site(tmp_path, stations=[station], table={"windows_deg": [15.0], "fit": "em"})
    ids = {build_table(path, tmp_path / "t.h5", jobs=jobs).table_id for jobs in (1, 2)}
    assert len(ids) == 1


# What goes wrong


def test_a_folder_that_is_missing(site_path: Path, tmp_path: Path) -> None:
    calls: list[str] = []
    path = tmp_path / "none" / "t.h5"
    with pytest.raises(TableError, match=re.escape(f"there is no folder {path.parent}; create it first")):
        build_table(site_path, path, progress=lambda stage, done, total: calls.append(stage))
    assert calls == []
    assert list(tmp_path.iterdir()) == []


def test_a_folder_for_a_file(site_path: Path, tmp_path: Path) -> None:
    with pytest.raises(TableError, match="it is a folder; give a file name"):
        build_table(site_path, tmp_path)


READ_ONLY = """
import os, sys
from rayfix_offline.build import build_table
from rayfix_tables.errors import TableError

if os.getuid() == 0:
    os.setuid(65534)
try:
    build_table(sys.argv[1], sys.argv[2])
except TableError as error:
    print(error)
"""


def test_a_folder_that_is_read_only(tmp_path_factory: pytest.TempPathFactory, write_site: WriteSite) -> None:
    """For root, who may write everywhere, as another user."""
    folder = tmp_path_factory.mktemp("readonly")
    site = write_site(folder)
    parents = [p for p in (folder, *folder.parents) if p.owner() == folder.owner() and not p.stat().st_mode & 0o001]
    modes = {parent: parent.stat().st_mode for parent in (folder, *parents)}
    if os.getuid() == 0:
        for parent in parents:
            parent.chmod(0o755)
    folder.chmod(0o555)
    command = [sys.executable, "-c", READ_ONLY, str(site), str(folder / "t.h5")]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    finally:
        for parent, mode in modes.items():
            parent.chmod(mode)
    assert done.stdout == f"cannot write {folder / 't.h5'}: the folder {folder} is read-only; choose another\n"
    assert not (folder / "t.h5").exists()


def test_a_site_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(SiteError, match="there is no site file"):
        build_table(tmp_path / "none.toml", tmp_path / "t.h5")
    assert list(tmp_path.iterdir()) == []


def test_a_station_in_a_wall_stops_the_build(tmp_path: Path, write_site: WriteSite) -> None:
    path = write_site(tmp_path, stations=[*TWO, {"id": "bs3", "position_m": [0.9, 1.5, 0.7]}])
    before = content(tmp_path)
    with pytest.raises(SceneError, match=r"station 'bs3' at .* lies inside the solid 'cabinet'"):
        build_table(path, tmp_path / "t.h5")
    assert content(tmp_path) == before


def test_no_cell_in_view(tmp_path: Path, write_site: WriteSite) -> None:
    """A cone of less than a hair, between the cells' centres, is widened by the window and meets at least one."""
    station = {**TWO[0], "field_of_view_deg": 1e-9}
    path = write_site(tmp_path, stations=[station], table={"windows_deg": [10.0]})
    build_table(path, tmp_path / "t.h5", jobs=1)
    (level,) = Table.open(tmp_path / "t.h5").levels("bs1")
    assert 1 <= np.count_nonzero(np.isfinite(level.cell_log_mass)) <= 4


def test_an_open_room_loses_rays_and_says_so(
    tmp_path: Path, write_site: WriteSite, cluttered_scene: trimesh.Scene
) -> None:
    """Without its ceiling; the station in a corner, 0.4 m below the rim, looks out over most of its upper half."""
    room = cluttered_scene.geometry["room"]
    room.update_faces(room.triangles[:, :, 2].min(axis=1) < 3.0)
    path = write_site(
        tmp_path, scene=cluttered_scene, table={"windows_deg": [15.0]}, propagation={"max_reflections": 0}
    )
    summary = build_table(path, tmp_path / "t.h5", jobs=1)
    (warning,) = summary.warnings
    assert warning.startswith("open parts without an inside: room;")
    lost = summary.stations[0].lost_ray_share
    # The ceiling would take 4 x 5 m, seen from 0.4 m below and 0.4 m from two of its edges.
    x, y = np.meshgrid(np.linspace(0.0, 4.0, 801) - 3.6, np.linspace(0.0, 5.0, 1001) - 0.4)
    solid_angle = np.mean(0.4 / (x**2 + y**2 + 0.4**2) ** 1.5) * 20.0
    assert lost == pytest.approx(solid_angle / (4.0 * np.pi), abs=0.01)
    assert lost > 0.2


def test_the_shortest_path_length(tmp_path: Path, write_site: WriteSite) -> None:
    """Rays of a millimetre; what is near the station is all there is."""
    path = write_site(tmp_path, propagation={"max_path_length_m": 0.001}, table={"windows_deg": [25.0]})
    build_table(path, tmp_path / "t.h5", jobs=1)
    (level,) = Table.open(tmp_path / "t.h5").levels("bs1")
    assert np.abs(level.mixture.x_mean - np.array((3.6, 0.4, 2.6))).max() < 2e-3
    assert np.isfinite(level.cell_log_mass).all()


# Interrupted


class Stopped:
    """Progress that presses Ctrl-C at the first call that fits."""

    def __init__(self, fits: Callable[[str, int, int], bool]) -> None:
        self.fits = fits

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Be told of the progress."""
        if self.fits(stage, done, total):
            raise KeyboardInterrupt


@pytest.mark.parametrize(
    "fits",
    [
        lambda stage, done, total: True,
        lambda stage, done, total: "bs2" in stage,
        lambda stage, done, total: 0 < done < total,
        lambda stage, done, total: stage == "writing",
    ],
    ids=["at once", "second station", "first cells", "writing"],
)
@pytest.mark.parametrize("former", [False, True], ids=["first table", "former table"])
def test_an_interrupted_build_leaves_only_finished_work(
    site_path: Path, table_path: Path, tmp_path: Path, fits: Callable[[str, int, int], bool], former: bool
) -> None:
    path = tmp_path / "t.h5"
    if former:
        path.write_bytes(b"\x89HDF\r\n\x1a\n, or what is left of a table")
    before = content(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        build_table(site_path, path, jobs=2, progress=Stopped(fits))
    after = content(tmp_path)
    assert {name: after[name] for name in before} == before
    assert all(name.startswith(".t.h5.shards") for name in set(after) - set(before))
    assert not any("partial" in name for name in after)


def test_a_build_after_an_interrupted_one_is_the_same(site_path: Path, table_path: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        build_table(site_path, tmp_path / "t.h5", jobs=2, progress=Stopped(lambda stage, done, total: done > 0))
    again = build_table(site_path, tmp_path / "t.h5", jobs=2)
    assert again.table_id == Table.open(table_path).table_id
