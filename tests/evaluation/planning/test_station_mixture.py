"""What a table says of the paths to a place, against straight lines."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_evaluation.drops.bound import path_gradients
from rayfix_evaluation.planning.station_mixture import audible_paths
from rayfix_tables.geometry.angles import angles_of, wrap
from rayfix_tables.table import Table

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def places() -> Array:
    x, y = np.meshgrid(np.arange(0.25, 4.0, 0.25), np.arange(0.25, 5.0, 0.25))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.1)], axis=-1)


def crossing(station: tuple[float, float, float], places: Array) -> Array:
    """Where straight paths pass the screen's middle, y at x = 2; infinite if they do not."""
    x, y = station[:2]
    share = np.divide(2.0 - x, places[:, 0] - x, out=np.full(len(places), np.inf), where=places[:, 0] != x)
    return np.where((share > 0.0) & (share < 1.0), y + share * (places[:, 1] - y), np.inf)


def test_places_behind_the_screen_are_not_audible(screen_table: Table, places: Array) -> None:
    free = np.abs(places[:, 0] - 2.0) > 0.2
    for station in screen_table.site.stations:
        predicted = audible_paths(screen_table.levels(station.id)[0], places)
        passes = crossing(station.position, places)
        # A window of 2.5 deg and the screen's thickness blur 0.4 m.
        assert predicted.audible[free & (passes > 3.9)].all()
        assert not predicted.audible[free & (passes < 3.1)].any()
        # The probabilities of all paths add up to 1 where there are any.
        inside = (passes > 4.2) & free & (places.min(axis=1) > 0.4) & (places[:, 0] < 3.6) & (places[:, 1] < 4.6)
        assert np.median(predicted.probability[inside]) == pytest.approx(1.0, abs=0.1)


def test_audible_paths_are_straight(screen_table: Table, places: Array) -> None:
    free = np.abs(places[:, 0] - 2.0) > 0.2
    solver = solver_of(screen_table)
    for station in screen_table.site.stations:
        predicted = audible_paths(screen_table.levels(station.id)[0], places)
        sure = np.flatnonzero(free & (crossing(station.position, places) > 3.9))
        offset = places[sure] - station.position
        azimuth, zenith = angles_of(offset)
        off = np.hypot(np.sin(zenith) * wrap(predicted.azimuth[sure] - azimuth), predicted.zenith[sure] - zenith)
        # A small part of the window of 2.5 deg; the table's tubes are straight, and next to a station angles are not.
        assert np.quantile(np.degrees(off), 0.9) < 0.25
        assert np.quantile(np.abs(predicted.path_length[sure] - np.linalg.norm(offset, axis=1)), 0.9) < 0.02
        for n in sure[::7]:
            exact = path_gradients(solver.paths(station.position, places[n]), 0)
            exact[0] *= np.sin(predicted.zenith[n])
            # Rows are azimuth, zenith, length there and length, tangent azimuth, zenith here.
            apart = np.linalg.norm(predicted.gradients[n] - exact[[2, 0, 1]], axis=1)
            assert (apart < 0.05 * np.linalg.norm(exact[[2, 0, 1]], axis=1)).all()


def test_nothing_is_told_of_places_outside(screen_table: Table) -> None:
    outside = np.array([[10.0, 2.0, 1.0], [-3.0, 1.0, 1.0]])
    predicted = audible_paths(screen_table.levels("a")[0], outside)
    assert not predicted.audible.any()
    for values in (
        predicted.probability,
        predicted.azimuth,
        predicted.zenith,
        predicted.path_length,
        predicted.gradients,
    ):
        np.testing.assert_array_equal(values, 0.0)


def test_the_order_of_places_does_not_matter(screen_table: Table, places: Array) -> None:
    level = screen_table.levels("b")[0]
    predicted = audible_paths(level, places)
    order = np.random.default_rng(1).permutation(len(places))
    mixed = audible_paths(level, places[order])
    np.testing.assert_allclose(mixed.probability, predicted.probability[order], rtol=1e-9)
    np.testing.assert_allclose(mixed.azimuth, predicted.azimuth[order], rtol=0, atol=1e-12)
    np.testing.assert_allclose(mixed.gradients, predicted.gradients[order], rtol=1e-9, atol=1e-12)
