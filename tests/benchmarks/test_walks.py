"""Walks stay clear of solids, and errors are counted as they should be."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.walks import Errors, walk
from rayfix_evaluation.drops.accuracy import clear_of_solids
from rayfix_service.tracking.walls import walls_of
from rayfix_tables.table import Table


def test_a_walk_is_clear_of_solids_and_of_its_speed(hall_table_path: Path):
    table = Table.open(hall_table_path)
    places = walk(table, np.random.default_rng(3), count=80, interval=0.5, speed=1.0)
    assert places.shape == (80, 3)
    assert clear_of_solids(table.scene.free_space, places, margin=0.25).all()
    assert walls_of(table.scene).passable(places[:-1], places[1:]).all()
    assert np.ptp(places[:, 2]) == 0.0
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    # Legs end where a report is due: their speed is within half a step of what was asked for.
    assert np.median(steps) == pytest.approx(0.5, rel=0.1)
    assert steps.max() < 0.8


def test_figures_of_errors():
    errors = Errors(distance=np.array([0.3, 0.4, 1.2]), nees=np.zeros(3))
    assert errors.rmse == pytest.approx((1.69 / 3) ** 0.5)
    assert errors.gross_share == pytest.approx(1 / 3)
