"""Forecasts of a room with a screen against measured errors, and their pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rayfix_evaluation.drops.accuracy import drops_at, locate_drops, solver_of
from rayfix_evaluation.drops.simulate import Noise, Timing
from rayfix_evaluation.planning.floor import slice_mesh
from rayfix_evaluation.planning.forecast import PlanMap, PlanSettings, draw_places, finite, forecast, summary
from rayfix_evaluation.planning.picture import changes, draw_comparison, draw_plan
from rayfix_service.locator import Locator
from rayfix_tables.errors import RayfixError
from rayfix_tables.table import Table

NOISE = Noise(azimuth_stdev=0.02, zenith_stdev=0.02, range_stdev=0.3)
SETTINGS = PlanSettings(height=1.1, noise=NOISE, timing="pt", spacing=0.5, threshold=0.15, draws=3)


@pytest.fixture(scope="module")
def plan(screen_table: Table) -> PlanMap:
    return forecast(screen_table, SETTINGS)


@pytest.mark.parametrize("timing", ["none", "pt", "toa", "tdoa"])
def test_forecast_errors_are_those_that_are_measured(screen_table: Table, timing: Timing) -> None:
    settings = replace(SETTINGS, timing=timing, spacing=0.7, draws=8)
    plan = forecast(screen_table, settings)
    _, places = draw_places(screen_table, 1.1, 0.7, 8, np.random.default_rng(5))
    drops = [drop for drop in drops_at(places, solver_of(screen_table), screen_table.site.stations) if drop.paths]
    error = locate_drops(Locator(screen_table), drops, NOISE, timing=timing, rng=np.random.default_rng(6)).error
    # Squares where one station alone is audible have no fix without times, or a poor one.
    usual, predicted = np.median(error), np.median(plan.error)
    assert usual == pytest.approx(predicted, rel=0.25)
    assert np.mean(error < 0.15) == pytest.approx(plan.coverage, abs=0.06)


def test_audible_stations_are_counted(screen_table: Table, plan: PlanMap) -> None:
    assert plan.audible.shape == (len(plan), 3)
    corner = np.argmin(np.linalg.norm(plan.position[:, :2] - [0.25, 0.25], axis=1))
    # Behind the screen for b; c sees over its end.
    assert plan.audible[corner].tolist() == [1.0, 0.0, 0.0]
    top = np.argmin(np.linalg.norm(plan.position[:, :2] - [2.25, 4.75], axis=1))
    assert plan.num_audible[top] == 3.0
    # Where fewer are audible, errors are larger.
    assert np.median(plan.error[plan.num_audible < 1.5]) > 1.2 * np.median(plan.error[plan.num_audible > 2.5])


def test_bounds_are_below_the_errors_and_grow_with_the_noise(screen_table: Table, plan: PlanMap) -> None:
    assert np.median(plan.error / plan.bound) == pytest.approx(1.0, abs=0.2)
    twice = Noise(azimuth_stdev=0.04, zenith_stdev=0.04, range_stdev=0.6)
    noisy = forecast(screen_table, replace(SETTINGS, noise=twice))
    np.testing.assert_allclose(noisy.bound, 2.0 * plan.bound, rtol=1e-9)
    assert np.median(noisy.error / plan.error) == pytest.approx(2.0, abs=0.4)
    assert noisy.coverage < plan.coverage


def test_forecasts_repeat(screen_table: Table, plan: PlanMap) -> None:
    again = forecast(screen_table, SETTINGS)
    np.testing.assert_array_equal(again.error, plan.error)
    other = forecast(screen_table, replace(SETTINGS, seed=2))
    assert not np.array_equal(other.error, plan.error)


def test_one_station_without_times_leaves_a_direction_open(fewer_path: Path) -> None:
    table = Table.open(fewer_path)
    angles = forecast(table, replace(SETTINGS, timing="none"))
    alone = angles.audible.sum(axis=1) == 1.0
    assert alone.sum() > 10
    assert np.isinf(angles.bound[alone]).all()
    assert np.isfinite(forecast(table, SETTINGS).bound[alone]).all()


def test_places_are_free_and_in_their_squares(screen_table: Table) -> None:
    squares, places = draw_places(screen_table, 1.1, 0.5, 5, np.random.default_rng(3))
    assert len(squares) == len(places) == 5 * len(np.unique(squares, axis=0))
    assert np.abs(places - squares)[:, :2].max() <= 0.25
    assert screen_table.scene.free_space.contains(places).all()
    assert (places[:, 2] == 1.1).all()
    # The screen fills 0.2 of 0.5 m.
    assert len(squares) == 5 * 8 * 10


def test_a_floor_without_free_places_is_refused(screen_table: Table) -> None:
    with pytest.raises(
        RayfixError, match=r"nothing is free at a height of 7\.0 m; the building reaches from .* to 3\.\d+ m"
    ):
        forecast(screen_table, replace(SETTINGS, height=7.0))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"spacing": 0.0}, r"the spacing is 0\.0 m; it must be positive"),
        ({"threshold": float("nan")}, r"the threshold is nan m; it must be positive"),
        ({"height": float("inf")}, r"the height is inf m; give the transmitters' z in the scene"),
        ({"draws": 0}, r"the number of draws is 0; give 1 or more"),
        ({"paths": 0}, r"the number of paths is 0; give 1 to 10"),
        ({"paths": 2, "timing": "tdoa"}, r"several paths have no time differences; give their times as 'toa'"),
        ({"noise": replace(NOISE, range_stdev=None)}, r"the timing is 'pt', but the standard deviation of a range"),
    ],
)
def test_settings_that_cannot_be_are_refused(changed: dict[str, object], message: str) -> None:
    with pytest.raises(RayfixError, match=message):
        replace(SETTINGS, **changed)  # type: ignore[arg-type]


def test_figures_of_a_map(plan: PlanMap) -> None:
    figures = summary(plan)
    assert figures["squares"] == len(plan) == 80
    assert figures["coverage"] == plan.within.mean()
    assert figures["error_m"]["50"] <= figures["error_m"]["90"]
    assert (plan.error <= figures["error_m"]["90"]).mean() >= 0.9
    lost = summary(replace(plan, error=np.full(len(plan), np.inf)))
    assert lost["error_m"] == {"50": None, "90": None}
    assert finite(1.5) == 1.5


def test_a_box_is_cut_into_its_outline() -> None:
    box = trimesh.creation.box(bounds=[(1, 2, 0), (3, 7, 2)])
    # Each side has two triangles: with its diagonal cut in the middle, two segments a side.
    cuts = slice_mesh(box.vertices, box.faces, 1.0)
    assert cuts.shape == (8, 2, 2)
    assert np.linalg.norm(cuts[:, 1] - cuts[:, 0], axis=1).sum() == pytest.approx(2 * (2 + 5), abs=1e-12)
    assert set(cuts[..., 0].ravel()) == {1.0, 2.0, 3.0}
    assert slice_mesh(box.vertices, box.faces, 2.5).shape == (0, 2, 2)
    # A slope: the cut moves with the height.
    sloping = slice_mesh([(0, 0, 0), (0, 1, 0), (4, 0, 2)], [(0, 1, 2)], 0.5)
    np.testing.assert_allclose(sorted(sloping[0].tolist()), [(1.0, 0.0), (1.0, 0.75)], rtol=0, atol=1e-12)


def test_changes_are_by_square(plan: PlanMap) -> None:
    same = changes(plan, plan)
    np.testing.assert_array_equal(same[0], 0.0)
    np.testing.assert_array_equal(same[1], 0.0)
    half = replace(
        plan,
        position=plan.position[:40],
        error=2.0 * plan.error[:40],
        within=plan.within[:40] - 0.1,
        audible=plan.audible[:40],
        bound=plan.bound[:40],
    )
    ratio, gain = changes(plan, half)
    np.testing.assert_allclose(ratio[:40], 1.0, rtol=1e-12)
    np.testing.assert_allclose(gain[:40], -0.1, rtol=1e-9)
    assert np.isnan(ratio[40:]).all()
    assert np.isnan(gain[40:]).all()


def test_pictures_are_drawn(screen_table: Table, plan: PlanMap, fewer_path: Path, tmp_path: Path) -> None:
    lost = replace(plan, error=np.where(plan.num_audible < 2.0, np.inf, plan.error))
    draw_plan(tmp_path / "one.png", screen_table, lost)
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")
    fewer = Table.open(fewer_path)
    draw_comparison(tmp_path / "two.svg", (fewer, forecast(fewer, SETTINGS)), (screen_table, plan))
    drawn = (tmp_path / "two.svg").read_text(encoding="utf-8")
    for text in ("ab.h5", "abc.h5", "change of the error", "probability of an error below 0.15 m"):
        assert f"<!-- {text}" in drawn or f": {text}" in drawn or text in drawn
