"""A build beside a former table keeps what has not changed: exactly, or within a tolerance that the table states."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from rayfix_offline.build import BuildSummary, build_table
from rayfix_tables.errors import BuildError, TableError
from rayfix_tables.geometry.mounting import boresight_of
from rayfix_tables.mixture import FIELD_SHAPES
from rayfix_tables.table import Table
from tests.support.tables.compact_copies import former_copy

SITE = """\
[site]
name = "two rooms"
scene = "rooms.ply"
[propagation]
max_reflections = 2
max_path_length_m = 20.0
[table]
windows_deg = [8.0, 20.0]
fit = "{fit}"
[[stations]]
id = "left"
position_m = [0.4, 0.5, 2.5]
field_of_view_deg = {view}
[[stations]]
id = "right"
position_m = [8.5, 0.6, 2.5]
"""
Point = tuple[float, float, float]


def write_site(
    folder: Path, *, left: Point = (2.4, 3.4, 0.2), right: Point = (6.5, 3.0, 0.2), fit: str = "tubes", view: int = 360
) -> Path:
    """Write two rooms with a wall between them and a crate in each, whose low corner is given.

    ::

        y = 5 +-----------+-+-----------+
              |   +--+    | |    +--+   |
              |   |l |    | |    |r |   |
              |   +--+    | |    +--+   |
              | left      | |     right |
        y = 0 +-----------+-+-----------+
            x = 0         4 4.2         9
    """
    folder.mkdir(exist_ok=True)
    rooms = trimesh.creation.box(bounds=[(0, 0, 0), (9, 5, 3)])
    rooms.invert()
    wall = trimesh.creation.box(bounds=[(4, -0.1, -0.1), (4.2, 5.1, 3.1)])
    crates = [trimesh.creation.box(bounds=[low, np.add(low, (0.6, 0.6, 0.7))]) for low in (left, right)]
    trimesh.util.concatenate([rooms, wall, *crates]).export(folder / "rooms.ply")
    (folder / "site.toml").write_text(SITE.format(fit=fit, view=view), encoding="utf-8")
    return folder / "site.toml"


@pytest.fixture(scope="module")
def former(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the table of the two rooms."""
    folder = tmp_path_factory.mktemp("former")
    return build_table(write_site(folder), folder / "former.h5", jobs=1).path


def station(summary: BuildSummary, name: str) -> tuple[str, float]:
    """Where a station's part came from, and the share of its cells that was kept."""
    (found,) = [s for s in summary.stations if s.station_id == name]
    return found.origin, found.num_kept_cells / found.num_finest_cells


def test_parts_of_a_former_format_are_built_again(former: Path, tmp_path: Path) -> None:
    """Their numbers are not those that a build would round; the table is what it is without them."""
    whole = Table.open(former)
    old = former_copy(whole, tmp_path / "old.h5")
    assert (whole.format_version, old.format_version) == (5, 4)
    summary = build_table(write_site(tmp_path / "site"), tmp_path / "new.h5", former=old.path, jobs=1)
    assert [station(summary, name)[0] for name in ("left", "right")] == ["built", "built"]
    assert summary.table_id == whole.table_id


def assert_within_its_changes(table: Table, whole: Table) -> dict[str, float]:
    """Compare an updated table with a whole build; return the share of cells of each station that differ."""
    differing = {}
    for name, part in table.parts.items():
        levels = whole.levels(name)
        changes = part.update.cell_change if part.update else [np.zeros(level.num_cells) for level in levels]
        for level, expected, change in zip(part.levels, levels, changes, strict=True):
            mass, expected_mass = np.exp(level.cell_log_mass), np.exp(expected.cell_log_mass)
            assert np.all(np.abs(mass - expected_mass) <= change * expected_mass * (1.0 + 1e-6))
            for cell in np.flatnonzero(change == 0.0):
                for field in FIELD_SHAPES:
                    ours, theirs = (getattr(lv.cell(int(cell)), field) for lv in (level, expected))
                    assert ours.tobytes() == theirs.tobytes()
        differing[name] = part.update.num_changed / sum(lv.num_cells for lv in levels) if part.update else 0.0
    return differing


def test_a_change_behind_a_wall_touches_nothing(tmp_path: Path, former: Path) -> None:
    site = write_site(tmp_path, right=(6.5, 3.5, 0.2))
    summary = build_table(site, tmp_path / "t.h5", former=former, jobs=1)
    assert station(summary, "left") == ("updated", 1.0)
    assert station(summary, "right")[1] < 1.0
    assert all(s.largest_change == 0.0 for s in summary.stations)
    assert summary.table_id == build_table(site, tmp_path / "whole.h5", jobs=1).table_id


def test_a_moved_object_within_a_tolerance(tmp_path: Path, former: Path) -> None:
    site, table = write_site(tmp_path, right=(6.5, 3.5, 0.2)), tmp_path / "t.h5"
    whole = build_table(site, tmp_path / "whole.h5", jobs=1)
    tolerance = 0.05
    summary = build_table(site, table, former=former, tolerance=tolerance, jobs=1)
    assert summary.table_id != whole.table_id
    updated = Table.open(table)
    updated.verify()
    differing = assert_within_its_changes(updated, Table.open(whole.path))
    assert differing["left"] == 0.0
    assert updated.parts["left"].update is None
    assert updated.parts["left"].part_id == Table.open(whole.path).parts["left"].part_id
    origin, share = station(summary, "right")
    assert origin == "updated"
    exact = station(build_table(site, tmp_path / "exact.h5", former=former, jobs=1), "right")[1]
    assert 0.2 < share < 1.0
    assert share > exact + 0.2
    update = updated.parts["right"].update
    assert update is not None
    assert update.exact_part_id == Table.open(whole.path).parts["right"].part_id
    assert update.former_part_id == Table.open(former).parts["right"].part_id
    assert 0.0 < update.largest_change <= update.tolerance == tolerance

    again = build_table(site, table, tolerance=tolerance, jobs=1)
    assert [s.origin for s in again.stations] == ["kept", "kept"]
    assert again.table_id == summary.table_id
    # Without a tolerance, the same command makes it exact again.
    exact_again = build_table(site, table, jobs=1)
    assert [s.origin for s in exact_again.stations] == ["kept", "updated"]
    assert exact_again.table_id == whole.table_id


@pytest.mark.slow
def test_changes_add_up(tmp_path: Path, former: Path) -> None:
    """Small steps do not let a cell drift further than the tolerance unseen."""
    table, tolerance = tmp_path / "t.h5", 0.05
    table.write_bytes(former.read_bytes())
    shares = []
    for step in range(1, 4):
        site = write_site(tmp_path, right=(6.5, 3.0 + 0.1 * step, 0.2))
        build_table(site, table, tolerance=tolerance, jobs=1)
        whole = build_table(site, tmp_path / f"whole-{step}.h5", jobs=1)
        updated = Table.open(table)
        shares.append(assert_within_its_changes(updated, Table.open(whole.path))["right"])
        assert updated.parts["right"].update.largest_change <= tolerance
    assert min(shares) > 0.1
    assert shares[0] > shares[-1]


def test_an_interrupted_update_goes_on(tmp_path: Path, former: Path) -> None:
    site = write_site(tmp_path, right=(6.5, 3.5, 0.2))
    whole = build_table(site, tmp_path / "whole.h5", former=former, tolerance=0.02, jobs=1)
    stages = []

    def stop(stage: str, done: int, total: int) -> None:
        stages.append(stage)
        if stage.startswith("right: 8 deg"):
            raise KeyboardInterrupt

    table = tmp_path / "t.h5"
    with pytest.raises(KeyboardInterrupt):
        build_table(site, table, former=former, tolerance=0.02, jobs=1, progress=stop)
    assert "right: comparing" in stages
    assert build_table(site, table, former=former, tolerance=0.02, jobs=1).table_id == whole.table_id
    assert build_table(site, tmp_path / "exact.h5", former=former, jobs=1).table_id != whole.table_id


@pytest.mark.slow
def test_another_field_of_view_keeps_the_cells_of_both(tmp_path: Path, former: Path) -> None:
    for view in (90, 180):
        site = write_site(tmp_path, view=view)
        summary = build_table(site, tmp_path / "t.h5", former=None if view == 180 else former, jobs=1)
        assert station(summary, "right") == ("kept", 1.0)
        origin, share = station(summary, "left")
        assert origin == "updated"
        assert 0.1 < share < 0.5
        assert summary.table_id == build_table(site, tmp_path / f"{view}.h5", jobs=1).table_id


def turned(site: Path, keys: str) -> Path:
    """Add keys to the left station."""
    text = site.read_text(encoding="utf-8")
    site.write_text(text.replace('id = "left"\n', f'id = "left"\n{keys}\n'), encoding="utf-8")
    return site


def test_a_turned_station_that_looks_all_around_is_kept(tmp_path: Path, former: Path) -> None:
    site = turned(write_site(tmp_path), 'mounting = "silabs"\nboresight_azimuth_deg = 70\nroll_deg = 10')
    summary = build_table(site, tmp_path / "t.h5", former=former, jobs=1)
    assert [s.origin for s in summary.stations] == ["kept", "kept"]
    part = Table.open(summary.path).parts["left"]
    assert part.station.mounting == "silabs"
    assert np.rad2deg(part.station.orientation) == pytest.approx((160.0, -10.0, 90.0), abs=1e-9)
    assert np.rad2deg(boresight_of(part.station)) == pytest.approx((70.0, 0.0), abs=1e-9)


@pytest.mark.slow
def test_of_a_turned_station_only_what_comes_into_view_is_built(tmp_path: Path, former: Path) -> None:
    looks = turned(write_site(tmp_path / "first", view=120), "boresight_azimuth_deg = 45")
    first = build_table(looks, tmp_path / "first.h5", former=former, jobs=1)
    _, in_view = station(first, "left")
    for keys, expected in (("boresight_azimuth_deg = 75", "updated"), ("orientation_deg = [45, 0, 30]", "kept")):
        site = turned(write_site(tmp_path, view=120), keys)
        summary = build_table(site, tmp_path / "t.h5", former=first.path, jobs=1)
        origin, share = station(summary, "left")
        assert origin == expected
        assert 0.6 * in_view < share < (0.9 if expected == "updated" else 1.1) * in_view
        assert summary.table_id == build_table(site, tmp_path / f"{origin}.h5", jobs=1).table_id


@pytest.mark.slow
def test_another_seed_or_place_keeps_nothing(tmp_path: Path, former: Path) -> None:
    site = write_site(tmp_path)
    text = site.read_text(encoding="utf-8")
    site.write_text(text.replace("[0.4, 0.5, 2.5]", "[0.5, 0.5, 2.5]"), encoding="utf-8")
    moved = build_table(site, tmp_path / "t.h5", former=former, jobs=1)
    assert [s.origin for s in moved.stations] == ["built", "kept"]
    site.write_text(text.replace("[table]", "[table]\nseed = 7"), encoding="utf-8")
    assert {s.origin for s in build_table(site, tmp_path / "t.h5", jobs=1).stations} == {"built"}


@pytest.mark.slow
def test_fits_by_em_are_kept_as_well(tmp_path: Path) -> None:
    def build(folder: Path, former: Path | None = None, **place: Point) -> BuildSummary:
        site = write_site(folder, fit="em", **place)
        site.write_text(site.read_text(encoding="utf-8").replace("[8.0, 20.0]", "[25.0]"), encoding="utf-8")
        return build_table(site, folder / "t.h5", former=former, jobs=2)

    first = build(tmp_path / "first")
    moved = build(tmp_path / "moved", first.path, right=(6.5, 3.5, 0.2))
    assert station(moved, "left") == ("updated", 1.0)
    assert moved.table_id == build(tmp_path / "whole", right=(6.5, 3.5, 0.2)).table_id


def test_a_former_table_that_was_named_must_be_one(tmp_path: Path) -> None:
    site = write_site(tmp_path)
    with pytest.raises(TableError, match="there is no table at"):
        build_table(site, tmp_path / "t.h5", former=tmp_path / "none.h5")


@pytest.mark.parametrize("tolerance", [-0.01, 1.0, float("nan")])
def test_a_tolerance_that_is_no_share(tmp_path: Path, tolerance: float) -> None:
    with pytest.raises(BuildError, match="is not a fraction of a cell's mass; give 0 or more, below 1"):
        build_table(write_site(tmp_path), tmp_path / "t.h5", tolerance=tolerance)
