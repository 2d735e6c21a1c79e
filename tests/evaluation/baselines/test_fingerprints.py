"""Fingerprints on a simulated map."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rayfix_evaluation.baselines.fingerprints import Fingerprinting, RadioMap, simulate_map
from rayfix_service.fusion.measurements.report import Report
from rayfix_tables.geometry.angles import direction
from rayfix_tables.table import Table
from tests.support.oracles.every_rival import every_rival


@pytest.fixture(scope="module")
def radio_map(room: Table) -> RadioMap:
    return simulate_map(room, spacing=1.0)


def test_the_map_is_what_straight_paths_say(room: Table, radio_map: RadioMap) -> None:
    """4 x 5 x 3 places in the middle of cubic metres; in an empty room the strongest path is the straight one."""
    assert len(radio_map) == 60
    np.testing.assert_allclose(np.unique(radio_map.position[:, 0]), [0.5, 1.5, 2.5, 3.5], rtol=0, atol=1e-12)
    for station in room.site.stations:
        offset = radio_map.position - station.position
        length = np.linalg.norm(offset, axis=1)
        np.testing.assert_allclose(radio_map.path_length[station.id], length, rtol=0, atol=1e-9)
        np.testing.assert_allclose(radio_map.direction[station.id], offset / length[:, None], rtol=0, atol=1e-9)
        assert radio_map.heard[station.id].all()


@pytest.mark.parametrize("kind", ["aoa", "pt", "tdoa", "toa"])
def test_a_place_of_the_map_is_found_exactly(room: Table, radio_map: RadioMap, measure: Any, kind: str) -> None:
    rival = Fingerprinting(radio_map=radio_map, site=room.site)
    place = np.array([1.5, 3.5, 1.5])
    found = rival.locate(Report(measurements=measure(kind, "abcd", place)))
    assert found is not None
    np.testing.assert_allclose(found, place, rtol=0, atol=1e-6)


def test_between_places_neighbours_are_averaged(room: Table, radio_map: RadioMap, measure: Any) -> None:
    """In the middle of a square of four places, which are its four nearest neighbours."""
    rival = Fingerprinting(radio_map=radio_map, site=room.site)
    point = np.array([2.0, 3.0, 1.5])
    found = rival.locate(Report(measurements=measure("aoa", "abcd", point) + measure("pt", "abcd", point)))
    assert found is not None
    assert np.linalg.norm(found - point) < 0.25
    single = Fingerprinting(radio_map=radio_map, site=room.site, neighbours=1)
    nearest = single.locate(Report(measurements=measure("aoa", "abcd", point)))
    assert nearest is not None
    assert np.linalg.norm(radio_map.position - nearest, axis=1).min() < 1e-9  # m; places are 1 m apart


def test_places_that_a_station_does_not_hear_are_kept_away(room: Table, radio_map: RadioMap, measure: Any) -> None:
    """Station a deaf in the half x < 2: its angle, though exact for a place there, speaks for the other half."""
    deaf = radio_map.position[:, 0] < 2.0
    heard = dict(radio_map.heard, a=~deaf)
    partly = replace(radio_map, heard=heard, direction=dict(radio_map.direction, a=np.where(deaf[:, None], 0.0, 1.0)))
    place = np.array([1.5, 3.5, 1.5])
    with_a = Fingerprinting(radio_map=partly, site=room.site).locate(Report(measurements=measure("pt", "a", place)))
    assert with_a is not None
    assert with_a[0] > 2.0
    # Stations that are not in the report do not count.
    without = Fingerprinting(radio_map=partly, site=room.site).locate(Report(measurements=measure("pt", "bcd", place)))
    np.testing.assert_allclose(without, place, rtol=0, atol=1e-6)


def test_noise_outweighs_precise_measurements_no_more(room: Table, radio_map: RadioMap, measure: Any) -> None:
    """A range that is 3 m off but says that it is noisy moves the fix less than one that claims to be good."""
    rival = Fingerprinting(radio_map=radio_map, site=room.site)
    place = np.array([1.5, 3.5, 1.5])
    first, *others = measure("pt", "abcd", place)
    off = [
        rival.locate(Report(measurements=(replace(first, path_length=first.path_length + 3.0, stdev=stdev), *others)))
        for stdev in (0.1, 10.0)
    ]
    assert np.linalg.norm(off[0] - place) > np.linalg.norm(off[1] - place)


def test_a_report_without_angles_and_times_has_no_neighbours(room: Table, radio_map: RadioMap) -> None:
    assert Fingerprinting(radio_map=radio_map, site=room.site).locate(Report(measurements=())) is None


def test_a_grid_without_a_free_place_says_so(room: Table) -> None:
    full = replace(
        room, scene=replace(room.scene, free_space=replace(room.scene.free_space, free=np.zeros((40, 50, 30), bool)))
    )
    with pytest.raises(ValueError, match=r"no position of a grid of 1\.0 m is free; reduce the spacing"):
        simulate_map(full, spacing=1.0)


def test_every_rival_has_a_name_of_its_own_and_locates(room: Table, measure: Any) -> None:
    point = np.array([2.5, 1.5, 1.5])
    rivals = every_rival(room, height=1.5, map_spacing=1.0)
    assert len({rival.name for rival in rivals}) == len(rivals) == 7
    report = Report(
        measurements=measure("aoa", "abcd", point) + measure("pt", "abcd", point) + measure("toa", "abcd", point)
    )
    for rival in rivals:
        found = rival.locate(report)
        assert found is not None, rival.name
        assert np.linalg.norm(found - point) < 0.05, rival.name


def test_directions_of_the_map_are_towards_the_incoming_ray(room: Table, measure: Any, radio_map: RadioMap) -> None:
    place = radio_map.position[17]
    for angle in measure("aoa", "abcd", place):
        np.testing.assert_allclose(
            radio_map.direction[angle.station_id][17], direction(angle.azimuth, angle.zenith), rtol=0, atol=1e-9
        )
