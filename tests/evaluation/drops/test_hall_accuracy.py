"""The whole chain against ground truth: simulated reports of the forward solver, located with built tables."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from rayfix.example.files import write_example
from rayfix_evaluation.drops.accuracy import Drop, clear_of_solids, drop_uniformly, locate_drops
from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report
from rayfix_offline.build import build_table
from rayfix_service.locator import Locator
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.table import Table
from tests.support.running.running_app import RunningApp
from tests.support.scenes.sites import stations_text


@pytest.fixture(scope="module")
def full_table(tmp_path_factory: pytest.TempPathFactory) -> Table:
    """Table of the bundled hall as ``rayfix demo`` builds it."""
    folder = tmp_path_factory.mktemp("full")
    build_table(write_example(folder), folder / "hall.h5")
    return Table.open(folder / "hall.h5")


@pytest.fixture(scope="module")
def drops(full_table: Table) -> list[Drop]:
    """300 uniform drops into the hall."""
    return drop_uniformly(full_table, 300, np.random.default_rng(20260131))


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "timing", "bar"), [(1.0, "pt", 0.45), (0.25, "pt", 0.15), (1.0, "none", 1.0)])
def test_90_percent_of_fixes_are_within_the_bar(
    full_table: Table, drops: list[Drop], degrees: float, timing: Timing, bar: float
) -> None:
    angle = float(np.deg2rad(degrees))
    noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=0.5 if timing == "pt" else None)
    found = locate_drops(Locator(full_table), drops, noise, timing=timing, rng=np.random.default_rng(7))
    assert np.percentile(found.error, 90, method="inverted_cdf") <= bar


@pytest.mark.slow
def test_most_pairs_have_no_line_of_sight(drops: list[Drop]) -> None:
    direct = sum(int(p.num_reflections.min() == 0) for drop in drops for p in drop.paths.values())
    assert direct / (4 * len(drops)) < 0.42


@pytest.mark.slow
def test_unheard_drops_count_as_errors(full_table: Table) -> None:
    noise = Noise(azimuth_stdev=0.01, zenith_stdev=0.01, range_stdev=0.5)
    unheard = Drop(position=np.ones(3), paths={})
    found = locate_drops(Locator(full_table), [unheard], noise, timing="pt", rng=np.random.default_rng(7))
    assert found.error.tolist() == [np.inf]
    assert found.status == ("unheard",)


def test_clear_of_solids_looks_around() -> None:
    free = np.ones((4, 4, 4), bool)
    free[2, 2, 2] = False
    space = FreeSpace(origin=np.zeros(3), voxel_size=1.0, free=free)
    points = np.array([[1.5, 1.5, 1.5], [1.5, 2.5, 2.5], [2.5, 2.5, 2.5], [1.05, 2.5, 2.5]])
    assert clear_of_solids(space, points, margin=0.6).tolist() == [True, False, False, True]


WAREHOUSE_STATIONS = {
    "w1": (-4.5, -9.0, 4.5),
    "w2": (5.5, -9.5, 4.8),
    "w3": (6.0, 0.5, 4.2),
    "w4": (6.0, 9.5, 4.6),
    "w5": (-3.8, 9.3, 5.0),
    "w6": (-3.5, 0.5, 4.0),
}


@pytest.fixture(scope="module")
def warehouse_table(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Table]:
    """Table of the real hall of ../shared/data, with windows that suit angles of 2 deg."""
    folder = tmp_path_factory.mktemp("warehouse")
    scene = (shared_data / "warehouse" / "warehouse_collision.ply").resolve()
    (folder / "site.toml").write_text(
        f'[site]\nname = "warehouse"\nscene = "{scene}"\n'
        f"[propagation]\nmax_reflections = 2\n[table]\nwindows_deg = [2.5]\n{stations_text(WAREHOUSE_STATIONS)}",
        encoding="utf-8",
    )
    build_table(folder / "site.toml", folder / "warehouse.h5")
    return Table.open(folder / "warehouse.h5")


@pytest.mark.slow
def test_reports_from_a_real_warehouse_are_located(warehouse_table: Table) -> None:
    drops = drop_uniformly(warehouse_table, 60, np.random.default_rng(5), max_height=2.5)
    angle = float(np.deg2rad(2.0))
    noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=0.5)
    found = locate_drops(Locator(warehouse_table), drops, noise, timing="pt", rng=np.random.default_rng(6))
    assert sum(len(drop.paths) == 6 for drop in drops) > 30
    # The bound of these drops is about 0.25 m in the median.
    assert np.median(found.error) < 1.3 * np.median(found.bound)
    assert np.percentile(found.error, 90, method="inverted_cdf") < 0.7


@pytest.mark.slow
def test_the_warehouse_is_served(warehouse_table: Table) -> None:
    drop = drop_uniformly(warehouse_table, 1, np.random.default_rng(8), max_height=2.0)[0]
    noise = Noise(azimuth_stdev=0.02, zenith_stdev=0.02, range_stdev=0.5)
    report = simulate_report(drop.paths, noise, rng=np.random.default_rng(9))
    with RunningApp(warehouse_table.path) as app:
        answer = app.post("/v1/positions", report)
    assert answer.status_code == httpx.codes.OK
    position = [answer.json()["position"][axis] for axis in "xyz"]
    assert np.linalg.norm(np.subtract(position, drop.position)) < 1.0
