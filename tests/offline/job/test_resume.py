"""A build that is interrupted, killed, or repeated with changes gives the table that it would have given at once."""

import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rayfix_offline import build
from rayfix_offline.build import BuildSummary, build_table
from rayfix_offline.job import plan
from rayfix_offline.job.shards import ShardStore
from rayfix_tables.errors import BuildError
from rayfix_tables.site import NO_BIAS
from rayfix_tables.table import Table
from tests.support.scenes.small_sites import write_site

STATIONS = {"a": (0.4, 0.5), "b": (3.5, 0.6), "c": (2.0, 4.5)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> BuildSummary:
    """Build the room's table without a break."""
    folder = tmp_path_factory.mktemp("whole")
    summary = build_table(write_site(folder, STATIONS), folder / "t.h5", jobs=1)
    assert [s.origin for s in summary.stations] == ["built"] * 3
    return summary


def interrupt_after(cells: int, site: Path, table: Path) -> None:
    """Build until this many cells are done."""

    def stop(stage: str, done: int, total: int) -> None:
        if done >= cells:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_table(site, table, jobs=1, progress=stop)


@pytest.mark.parametrize("cells", [1, 500, 1500, 2500])
def test_an_interrupted_build_goes_on(cells: int, tmp_path: Path, whole: BuildSummary) -> None:
    site, table = write_site(tmp_path, STATIONS), tmp_path / "t.h5"
    interrupt_after(cells, site, table)
    assert not table.exists()
    first_done: list[int] = []
    summary = build_table(
        site, table, jobs=2, progress=lambda stage, done, total: first_done.append(done) if total else None
    )
    assert summary.table_id == whole.table_id
    assert min(first_done) >= 0
    assert "resumed" in {s.origin for s in summary.stations}
    assert {p.name for p in tmp_path.iterdir()} == {"room.ply", "site.toml", "t.h5"}


def test_finished_blocks_are_not_fitted_again(tmp_path: Path, whole: BuildSummary) -> None:
    site, table = write_site(tmp_path, STATIONS), tmp_path / "t.h5"
    interrupt_after(sum(s.num_cells for s in whole.stations), site, table)
    times = {p: p.stat().st_mtime_ns for p in ShardStore.beside(table).folder.iterdir()}
    assert len(times) > 10
    interrupt_after(sum(s.num_cells for s in whole.stations), site, table)
    assert {p: p.stat().st_mtime_ns for p in ShardStore.beside(table).folder.iterdir()} == times
    assert build_table(site, table, jobs=1).table_id == whole.table_id


@pytest.mark.parametrize("damage", ["flip", "cut", "empty"])
def test_a_damaged_shard_is_built_again(damage: str, tmp_path: Path, whole: BuildSummary) -> None:
    site, table = write_site(tmp_path, STATIONS), tmp_path / "t.h5"
    interrupt_after(1500, site, table)
    shards = sorted(ShardStore.beside(table).folder.iterdir())
    for shard in shards[:4]:
        content = bytearray(shard.read_bytes())
        if damage == "flip":
            content[len(content) // 2] ^= 1
        shard.write_bytes({"flip": content, "cut": content[: len(content) // 2], "empty": b""}[damage])
    assert build_table(site, table, jobs=1).table_id == whole.table_id


def test_a_shard_of_blocks_of_another_size_is_not_taken(
    tmp_path: Path, whole: BuildSummary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shards are named by their block's number, which stands for other cells when blocks are smaller."""
    site, table = write_site(tmp_path, STATIONS), tmp_path / "t.h5"
    interrupt_after(1500, site, table)
    monkeypatch.setattr(plan, "BLOCK_CELLS", 100)
    assert build_table(site, table, jobs=1).table_id == whole.table_id


@pytest.mark.slow
def test_a_killed_build_goes_on(tmp_path: Path, whole: BuildSummary) -> None:
    site, table = write_site(tmp_path, STATIONS), tmp_path / "t.h5"
    rng = random.Random(3)
    command = [sys.executable, "-m", "rayfix", "build", str(site), "-o", str(table), "--no-progress", "--jobs", "2"]
    kills = 0
    for _ in range(4):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        folder = ShardStore.beside(table).folder
        before = len(list(folder.glob("*"))) if folder.is_dir() else 0
        deadline = time.monotonic() + 60.0
        # Kill at a random moment after the build has got further than the one before.
        while process.poll() is None and time.monotonic() < deadline:
            if folder.is_dir() and len(list(folder.glob("*"))) > before:
                break
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, 0.05))
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            kills += 1
        process.wait()
    assert kills >= 2
    summary = build_table(site, table, jobs=2)
    assert summary.table_id == whole.table_id
    assert {p.name for p in tmp_path.iterdir()} == {"room.ply", "site.toml", "t.h5"}


def test_a_full_disk_loses_nothing_finished(tmp_path: Path, whole: BuildSummary) -> None:
    site, table = write_site(tmp_path, STATIONS), tmp_path / "t.h5"
    interrupt_after(900, site, table)
    folder = ShardStore.beside(table).folder
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    smallest = min(len(content) for content in before.values())
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    former = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (smallest // 2, hard))
        with pytest.raises(BuildError, match=r"cannot save .*: File too large; finished blocks are kept: free some"):
            build_table(site, table, jobs=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, former)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    assert build_table(site, table, jobs=1).table_id == whole.table_id


def origins(summary: BuildSummary) -> dict[str, str]:
    """Where each station's part came from."""
    return {s.station_id: s.origin for s in summary.stations}


def test_only_what_changed_is_built_again(tmp_path: Path, whole: BuildSummary) -> None:
    table = tmp_path / "t.h5"
    table.write_bytes(whole.path.read_bytes())
    again = build_table(write_site(tmp_path, STATIONS), table, jobs=1)
    assert origins(again) == {"a": "kept", "b": "kept", "c": "kept"}
    assert again.table_id == whole.table_id

    moved = build_table(write_site(tmp_path, {**STATIONS, "b": (3.4, 0.6)}), table, jobs=1)
    assert origins(moved) == {"a": "kept", "b": "built", "c": "kept"}
    assert moved.table_id != whole.table_id
    fresh = build_table(tmp_path / "site.toml", tmp_path / "fresh.h5", jobs=1)
    assert fresh.table_id == moved.table_id

    removed = build_table(write_site(tmp_path, {"c": STATIONS["c"], "a": STATIONS["a"]}), table, jobs=1)
    assert origins(removed) == {"c": "kept", "a": "kept"}
    added = build_table(write_site(tmp_path, STATIONS), table, jobs=1)
    assert origins(added) == {"a": "kept", "b": "built", "c": "kept"}
    assert added.table_id == whole.table_id
    Table.open(table).verify()


def test_a_bias_rebuilds_nothing(tmp_path: Path, whole: BuildSummary) -> None:
    """It is the fusion's; but the answers change, and with them the table's id."""
    table = tmp_path / "t.h5"
    table.write_bytes(whole.path.read_bytes())
    site = write_site(tmp_path, STATIONS)
    text = site.read_text(encoding="utf-8")
    site.write_text(text + "bias = { range_m = 0.25, azimuth_deg = 2.0 }\n", encoding="utf-8")
    biased = build_table(site, table, jobs=1)
    assert origins(biased) == {"a": "kept", "b": "kept", "c": "kept"}
    assert biased.table_id != whole.table_id
    biases = {station.id: station.bias for station in Table.open(table).site.stations}
    assert (biases["c"].range, biases["c"].azimuth) == (0.25, pytest.approx(np.deg2rad(2.0)))
    assert biases["a"] == biases["b"] == NO_BIAS
    assert build_table(write_site(tmp_path, STATIONS), table, jobs=1).table_id == whole.table_id


def test_a_balance_is_kept_with_its_part_and_made_where_there_is_none(
    tmp_path: Path, whole: BuildSummary, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, table = write_site(tmp_path, STATIONS), tmp_path / "t.h5"
    with monkeypatch.context() as early:
        early.setattr(
            build, "balanced", lambda level, free_space, settings, *, advance: level
        )  # as the first tables were
        unbalanced = build_table(site, table, jobs=1)
    assert unbalanced.table_id != whole.table_id
    again = build_table(site, table, jobs=1)
    assert set(origins(again).values()) == {"kept"}
    assert again.table_id == whole.table_id
    with monkeypatch.context() as idle:
        idle.setattr(build, "balanced", lambda level, free_space, settings, *, advance: pytest.fail("balanced anew"))
        assert build_table(site, table, jobs=1).table_id == whole.table_id


def test_another_scene_or_seed(tmp_path: Path, whole: BuildSummary) -> None:
    table = tmp_path / "t.h5"
    table.write_bytes(whole.path.read_bytes())
    higher = build_table(write_site(tmp_path, STATIONS, box=1.4), table, jobs=1)
    assert "kept" not in origins(higher).values()
    assert higher.table_id == build_table(tmp_path / "site.toml", tmp_path / "fresh.h5", jobs=1).table_id
    other = build_table(write_site(tmp_path, STATIONS, seed=2), table, jobs=1)
    assert set(origins(other).values()) == {"built"}


def test_a_damaged_former_table_is_not_reused(tmp_path: Path, whole: BuildSummary) -> None:
    table = tmp_path / "t.h5"
    content = bytearray(whole.path.read_bytes())
    content[len(content) // 2] ^= 1
    table.write_bytes(content)
    again = build_table(write_site(tmp_path, STATIONS), table, jobs=1)
    assert set(origins(again).values()) == {"built"}
    assert again.table_id == whole.table_id


def test_shards_of_another_site_are_not_taken(tmp_path: Path, whole: BuildSummary) -> None:
    table = tmp_path / "t.h5"
    interrupt_after(1500, write_site(tmp_path, STATIONS, seed=9), table)
    again = build_table(write_site(tmp_path, STATIONS), table, jobs=1)
    assert set(origins(again).values()) == {"built"}
    assert again.table_id == whole.table_id
    assert not ShardStore.beside(table).folder.exists()
