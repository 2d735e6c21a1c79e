"""Strongest paths of a place beside the forward solver, and forecasts of reports that hold several."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_evaluation.drops.bound import path_gradients
from rayfix_evaluation.drops.simulate import Noise
from rayfix_evaluation.planning.forecast import PlanSettings, draw_places, forecast
from rayfix_evaluation.planning.several_paths import strongest_paths
from rayfix_tables.errors import RayfixError
from rayfix_tables.geometry.angles import wrap
from rayfix_tables.table import Table

NOISE = Noise(azimuth_stdev=0.02, zenith_stdev=0.02, range_stdev=0.3)
SETTINGS = PlanSettings(height=1.1, noise=NOISE, timing="pt", spacing=0.7, draws=2)


@pytest.fixture(scope="module")
def hall(hall_table_path: Path) -> Table:
    return Table.open(hall_table_path)


def test_strongest_paths_are_those_of_the_forward_solver(hall: Table) -> None:
    _, places = draw_places(hall, 1.1, 2.0, 1, np.random.default_rng(5))
    solver = solver_of(hall)
    found_of_all = compared = 0
    for station in hall.site.stations:
        stored = hall.parts[station.id].paths
        assert stored is not None
        truth = solver.station(station.position)
        for place, found in zip(places, strongest_paths(stored, places - hall.scene.origin, 3), strict=True):
            paths = truth.paths(place)
            for n in range(len(found.length)):
                compared += 1
                apart = np.abs(paths.path_length - found.length[n]) + np.abs(wrap(paths.azimuth - found.azimuth[n]))
                if not len(apart) or apart.min() > 1e-6:
                    continue  # at the edge of what the path reaches
                found_of_all += 1
                index = int(np.argmin(apart))
                assert paths.zenith[index] == pytest.approx(found.zenith[n], abs=1e-9)
                azimuth, zenith, length = path_gradients(paths, index)
                across = np.sin(found.zenith[n]) * azimuth
                np.testing.assert_allclose(found.gradients[n], [length, across, zenith], rtol=0, atol=1e-6)
    assert found_of_all > 0.9 * compared > 100


def test_more_paths_make_smaller_errors(hall: Table) -> None:
    settings = replace(SETTINGS, spacing=2.0)
    one, three = (forecast(hall, replace(settings, paths=count)) for count in (1, 3))
    assert (three.bound <= one.bound * (1.0 + 1e-9)).mean() > 0.95
    assert np.median(three.bound) < 0.95 * np.median(one.bound)
    assert np.median(three.error) < np.median(one.error)
    unknown = forecast(hall, replace(settings, paths=3, timing="toa"))
    assert (unknown.bound >= three.bound * (1.0 - 1e-9)).all()


def test_more_paths_than_a_report_may_have_are_refused(screen_table: Table) -> None:
    stations = tuple(
        replace(station, id=f"{station.id}{n}") for n in range(3) for station in screen_table.site.stations
    )
    with pytest.raises(RayfixError, match=r"9 stations with 7 paths each are more than 62 .* give --paths 6 or less"):
        forecast(replace(screen_table, site=replace(screen_table.site, stations=stations)), replace(SETTINGS, paths=7))


def test_a_table_without_gains_says_how_to_get_them(screen_table: Table, tmp_path: Path) -> None:
    part = screen_table.parts[screen_table.site.stations[0].id]
    assert part.paths is not None
    former = replace(part.paths, log_gain=np.zeros(0, np.float16), lit=np.zeros(0, np.float16))
    with pytest.raises(RayfixError, match=r"has no gains of single paths.*; build it again"):
        strongest_paths(former, np.zeros((1, 3)), 2)
