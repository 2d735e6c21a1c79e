"""Drops located by a chosen path of each station."""

from pathlib import Path

import numpy as np
import pytest

from rayfix_evaluation.drops.accuracy import drop_positions, drops_at, locate_drop, solver_of
from rayfix_evaluation.drops.bound import position_error_bound
from rayfix_evaluation.drops.simulate import Noise, Rule
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

NOISE = Noise(azimuth_stdev=0.02, zenith_stdev=0.02, range_stdev=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["strongest", "first", "random"])
def test_the_bound_is_that_of_the_reported_paths(hall_table_path: Path, rule: Rule) -> None:
    table = Table.open(hall_table_path)
    stations = table.site.stations
    points = drop_positions(table, 30, np.random.default_rng(3))
    drop = max(drops_at(points, solver_of(table), stations), key=lambda d: sum(len(p) for p in d.paths.values()))
    found = locate_drop(Locator(table), drop, NOISE, timing="pt", rng=np.random.default_rng(4), rule=rule)
    reported = found.drop.paths
    assert set(reported) == set(drop.paths)
    for name, paths in reported.items():
        assert len(paths) == 1
        assert paths.path_length[0] in drop.paths[name].path_length
        if rule == "first":
            assert paths.path_length[0] == drop.paths[name].path_length.min()
        if rule == "strongest":
            assert paths.gain_db[0] == drop.paths[name].gain_db.max()
    chosen = [drop.paths[name].path_length.tolist().index(p.path_length[0]) for name, p in reported.items()]
    positions = np.array([s.position for s in stations if s.id in reported])
    bound = position_error_bound(positions, list(drop.paths.values()), chosen, drop.position, NOISE, timing="pt")
    assert found.bound == pytest.approx(bound, rel=1e-12)
    assert found.error == pytest.approx(np.linalg.norm(found.fix.position - drop.position), rel=1e-12)


@pytest.mark.slow
def test_a_moved_scene_has_other_paths(hall_table_path: Path) -> None:
    """The hall raised by a metre as a whole: what it was at a point, it is a metre above."""
    table = Table.open(hall_table_path)
    (before,) = drops_at(np.array([[4.6, 9.5, 1.2]]), solver_of(table), table.site.stations)
    assert len(before.paths) >= 2
    up = np.array([0.0, 0.0, 1.0])
    solver = solver_of(table, np.add(table.scene.vertices, up))
    for station in table.site.stations:
        above = solver.paths(np.add(station.position, up), before.position + up)
        heard = before.paths[station.id].path_length if station.id in before.paths else []
        np.testing.assert_allclose(above.path_length, heard, rtol=0, atol=1e-9)
