"""Simulated cases: what is spoilt changes as it should, and the rest stays."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from rayfix_evaluation.drops.accuracy import Drop, drops_at
from rayfix_evaluation.studies.cases import Case, Simulated, in_view, simulate_case
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_tables.site import Station, StationBias

STATIONS = (
    Station(id="a", position=(0.2, 0.2, 2.6)),
    Station(id="b", position=(4.8, 0.2, 2.6)),
    Station(id="c", position=(4.8, 3.8, 2.6)),
)


@pytest.fixture(scope="module")
def drop() -> Drop:
    """Drop a transmitter into an empty room of 5 x 4 x 3 m, each station hears it directly and by six walls."""
    room = trimesh.creation.box(bounds=[(0, 0, 0), (5, 4, 3)])
    solver = ForwardSolver.from_mesh(room.vertices, room.faces, max_reflections=1)
    (found,) = drops_at(np.array([[3.0, 2.5, 1.2]]), solver, STATIONS)
    return found


def simulate(case: Case, drop: Drop, stations: tuple[Station, ...] = STATIONS) -> Simulated:
    return simulate_case(case, drop, 7, stations, 1)


def by_station(simulated: Simulated, kind: str) -> dict[str, Any]:
    return {m["station_id"]: m for m in simulated.report["measurements"] if m["type"] == kind}


def test_the_noise_is_the_same_in_all_cases(drop: Drop) -> None:
    """Twice the deviation, twice the deviation from the truth."""
    one, two = (by_station(simulate(Case(range_stdev=s), drop), "pt") for s in (0.5, 1.0))
    for name, paths in drop.paths.items():
        truth = paths.path_length[np.argmax(paths.gain_db)]
        assert two[name]["range_m"] - truth == pytest.approx(2.0 * (one[name]["range_m"] - truth), rel=1e-9)


def test_a_difference_has_the_stated_deviation(drop: Drop) -> None:
    found = by_station(simulate(Case(timing="tdoa", range_stdev=0.7), drop), "tdoa")
    assert [m["stdev_m"] for m in found.values()] == pytest.approx([0.7, 0.7])


def test_silent_stations_leave_the_others_alone(drop: Drop) -> None:
    whole = by_station(simulate(Case(), drop), "aoa")
    without = by_station(simulate(Case(without="b"), drop), "aoa")
    assert without == {name: whole[name] for name in ("a", "c")}
    for heard in (1, 2):
        left = by_station(simulate(Case(heard=heard), drop), "aoa")
        assert len(left) == heard
        assert left.items() <= whole.items()


def test_fewer_stations_have_a_larger_bound(drop: Drop) -> None:
    bounds = [simulate(Case(heard=n), drop).bound for n in (1, 2, 3)]
    assert bounds[0] > bounds[1] > bounds[2]


def test_blocked_direct_paths_leave_reflections(drop: Drop) -> None:
    assert simulate(Case(), drop).hidden == 0
    assert simulate(Case(blocked=1.0), drop).hidden == 3


def test_told_deviations_change_nothing_else(drop: Drop) -> None:
    true, told = (by_station(simulate(Case(told=f), drop), "pt") for f in (1.0, 0.5))
    for name, m in true.items():
        assert told[name] == {**m, "stdev_m": 0.5 * m["stdev_m"]}


def test_random_angles_and_late_times_are_of_so_many_stations(drop: Drop) -> None:
    sound = simulate(Case(), drop)
    for count in (1, 2):
        angles = by_station(simulate(Case(random_angles=count), drop), "aoa")
        assert sum(angles[n] != m for n, m in by_station(sound, "aoa").items()) == count
        times = by_station(simulate(Case(late_times=count), drop), "pt")
        late = [times[n]["range_m"] - m["range_m"] for n, m in by_station(sound, "pt").items()]
        assert sorted(late) == pytest.approx([0.0] * (3 - count) + [10.0] * count)


def test_a_bias_has_one_sign_for_each_station_and_angle(drop: Drop) -> None:
    sound = by_station(simulate(Case(), drop), "aoa")
    shifts = []
    for number in (1, 2):
        case = Case(bias_deg=2.0)
        biased = by_station(simulate_case(case, drop, number, STATIONS, 1), "aoa")
        sound = by_station(simulate_case(Case(), drop, number, STATIONS, 1), "aoa")
        shifts.append([biased[n][k] - m[k] for n, m in sound.items() for k in ("azimuth_deg", "zenith_deg")])
    assert shifts[0] == pytest.approx(shifts[1])
    assert np.abs(shifts[0]) == pytest.approx(2.0)


def test_what_the_site_says_a_station_measures_wrongly_it_does(drop: Drop) -> None:
    bias = StationBias(range=0.3, azimuth=0.02)
    known = (replace(STATIONS[0], bias=bias), *STATIONS[1:])
    sound, biased = simulate(Case(), drop), simulate(Case(), drop, known)
    for name in "abc":
        late = by_station(biased, "pt")[name]["range_m"] - by_station(sound, "pt")[name]["range_m"]
        off = by_station(biased, "aoa")[name]["azimuth_deg"] - by_station(sound, "aoa")[name]["azimuth_deg"]
        assert late == pytest.approx(0.3 if name == "a" else 0.0, abs=1e-12)
        assert off == pytest.approx(np.degrees(0.02) if name == "a" else 0.0, abs=1e-9)


def test_paths_from_behind_are_not_in_view(drop: Drop) -> None:
    """A station that looks along +y, with a field of view of 180 deg, hears what comes from y above its own."""
    station = replace(STATIONS[0], orientation=(np.pi / 2, 0.0, 0.0), field_of_view=np.pi)
    paths = drop.paths["a"]
    seen = in_view(station, paths)
    expected = np.sin(paths.azimuth) * np.sin(paths.zenith) >= 0.0
    assert 0 < len(seen) < len(paths)
    assert seen.path_length.tolist() == paths.path_length[expected].tolist()
