"""What a receiver says of a direct path, against closed forms: two tubes of a station, one direct and one reflected."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rayfix_service.fusion.lookup.lookup import look_up
from rayfix_service.fusion.measurements.directions import NO_DIRECTION, Direction
from rayfix_service.fusion.measurements.line_of_sight import LineOfSightWeights
from rayfix_service.fusion.measurements.report import Angle, Measurement, Range, Report
from rayfix_service.fusion.posterior.fix import Fix
from rayfix_service.fusion.product.station_mixture import StationMixtures, is_direct
from rayfix_service.locator import Locator
from rayfix_tables.table import Table
from tests.support.messages.hand_reports import EXACT, angle_of
from tests.support.running.running_app import RunningApp
from tests.support.tables.hand_tables import POSITIONS, UE, MakeTable, Tube, line_of_sight

APART = np.array([0.0, 12.0, 0.0])
LENGTH = float(np.linalg.norm(UE - np.array(POSITIONS["a"])))


def pair(log_odds: float) -> list[Tube]:
    """Two tubes of one angle and one length: a direct one to the UE, a reflected one to a place 12 m from it."""
    direct = line_of_sight("a", log_mass=log_odds)
    return [direct, replace(direct, log_mass=0.0, x_mean=UE + APART, num_reflections=2)]


def at(fix: Fix, place: np.ndarray) -> float:
    """Probability of the candidate within 2 m of a place."""
    return sum(c.probability for c in fix.candidates if np.linalg.norm(c.position - place) < 2.0)


MEASUREMENTS: dict[str, list[Measurement]] = {
    "angle": [angle_of(line_of_sight("a"))],
    "range": [Range(station_id="a", path_length=LENGTH + 0.2, stdev=0.4)],
    "both": [angle_of(line_of_sight("a")), Range(station_id="a", path_length=LENGTH + 0.2, stdev=0.4)],
}


@pytest.mark.parametrize("kind", MEASUREMENTS)
@pytest.mark.parametrize("log_odds", [0.0, -1.5])
@pytest.mark.parametrize("probability", [0.1, 0.5, 0.8])
def test_the_odds_of_a_direct_path_are_multiplied(
    make_table: MakeTable, kind: str, log_odds: float, probability: float
) -> None:
    """By p / (1 - p), and what is lost to outliers keeps its evidence."""
    locator = Locator(make_table(*pair(log_odds)), EXACT)
    measured = MEASUREMENTS[kind]
    plain = locator.locate(Report(measurements=tuple(measured)))
    said = locator.locate(Report(measurements=tuple(replace(m, los_probability=probability) for m in measured)))
    direct, reflected = at(plain, UE), at(plain, UE + APART)
    assert direct / reflected == pytest.approx(np.exp(log_odds), rel=1e-5)
    lost = 1.0 - direct - reflected
    evidence = direct * 2.0 * probability + reflected * 2.0 * (1.0 - probability) + lost
    assert said.log_evidence - plain.log_evidence == pytest.approx(np.log(evidence), abs=1e-6)  # nats
    assert at(said, UE) == pytest.approx(direct * 2.0 * probability / evidence, abs=1e-6)
    assert at(said, UE + APART) == pytest.approx(reflected * 2.0 * (1.0 - probability) / evidence, abs=1e-6)


def test_even_odds_change_nothing_at_all(make_table: MakeTable) -> None:
    locator = Locator(make_table(*pair(-0.7)))
    (angle,) = MEASUREMENTS["angle"]
    plain, said = (locator.locate(Report(measurements=(replace(angle, los_probability=p),))) for p in (None, 0.5))
    assert said.log_evidence == plain.log_evidence
    for one, other in zip(said.candidates, plain.candidates, strict=True):
        assert one.probability == other.probability
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize(("sure", "softened"), [(1.0, 0.8), (0.0, 0.2)])
def test_a_sure_receiver_is_wrong_now_and_then(make_table: MakeTable, sure: float, softened: float) -> None:
    locator = Locator(make_table(*pair(0.0)), replace(EXACT, sight_error=0.2))
    (angle,) = MEASUREMENTS["angle"]
    fixes = [locator.locate(Report(measurements=(replace(angle, los_probability=p),))) for p in (sure, softened)]
    assert fixes[0].log_evidence == fixes[1].log_evidence
    assert at(fixes[0], UE) == at(fixes[1], UE)


def test_the_measurements_of_one_path_say_it_once(make_table: MakeTable) -> None:
    """Angle and range of one signal count as their mean."""
    locator = Locator(make_table(*pair(0.0)), EXACT)
    angle, length = MEASUREMENTS["both"]
    assert isinstance(angle, Angle)
    assert isinstance(length, Range)
    ways = [(0.9, 0.5), (0.7, None), (None, 0.7), (0.7, 0.7)]
    fixes = [
        locator.locate(
            Report(measurements=(replace(angle, los_probability=first), replace(length, los_probability=second)))
        )
        for first, second in ways
    ]
    for fix in fixes[1:]:
        assert at(fix, UE) == pytest.approx(at(fixes[0], UE), abs=1e-12)
    # Its own path only: what the second angle's receiver says leaves the first one's path alone.
    second = replace(angle, azimuth=angle.azimuth + 0.01, los_probability=0.1)
    twice = [locator.locate(Report(measurements=(replace(angle, los_probability=p), second))) for p in (None, 0.5)]
    assert at(twice[0], UE) == pytest.approx(at(twice[1], UE), abs=1e-12)
    assert at(twice[0], UE) < 0.2


DIRECTIONS = {
    "one cell": Direction(azimuth=0.6, zenith=1.7, cov=np.diag([0.02, 0.02]) ** 2),
    "cells around": Direction(azimuth=0.6, zenith=1.7, cov=np.diag([0.2, 0.3]) ** 2),
    "correlated": Direction(azimuth=0.6, zenith=1.7, cov=np.array([[0.09, 0.05], [0.05, 0.09]])),
    "azimuth only": Direction(azimuth=0.6, zenith=None, cov=np.diag([0.02**2, np.inf])),
    "none": NO_DIRECTION,
}


@pytest.fixture(scope="module")
def hall_table(hall_table_path: Path) -> Table:
    return Table.open(hall_table_path)


@pytest.mark.parametrize("name", DIRECTIONS)
def test_direct_and_reflected_paths_make_all_paths(hall_table: Table, name: str) -> None:
    """In a table with many components a cell: weighed by (a, b), the evidence is a of the one and b of the other."""
    station, measured = StationMixtures(hall_table.parts["bs1"]), DIRECTIONS[name]

    def evidence(line_of_sight_weights: LineOfSightWeights | None) -> float:
        return float(np.exp(station.towards(measured, line_of_sight_weights).log_evidence).sum())

    whole, direct = evidence(None), evidence(LineOfSightWeights(0.0, -np.inf))
    reflected = evidence(LineOfSightWeights(-np.inf, 0.0))
    assert direct > 0.05 * whole
    assert reflected > 0.05 * whole
    assert direct + reflected == pytest.approx(whole, rel=1e-9)
    assert evidence(LineOfSightWeights(np.log(1.8), np.log(0.2))) == pytest.approx(
        1.8 * direct + 0.2 * reflected, rel=1e-9
    )


def test_components_are_told_by_the_reflections_of_the_table(hall_table: Table, make_table: MakeTable) -> None:
    """Cell by cell, as the table has them, empty cells among them."""
    lookup = look_up(hall_table.parts["bs1"].levels, DIRECTIONS["cells around"])
    cells = [lookup.level.cell(int(cell)) for cell in lookup.cells]
    assert len(cells) > 5
    expected = [count == 0 for cell in cells for count in cell.num_reflections.tolist()]
    assert is_direct(lookup).tolist() == expected
    obstructed = replace(pair(0.0)[0], num_walls=1)
    by_hand = make_table(*pair(0.0), obstructed).parts["a"]
    assert is_direct(look_up(by_hand.levels, NO_DIRECTION)).tolist() == [True, False, False]


def test_a_receivers_word_decides_between_a_place_and_its_mirror_image(hall_app: RunningApp) -> None:
    """One angle and a rough range in the hall: before a machine or, by way of its side, beside it."""
    station, zenith, azimuth = np.array([0.1, 0.1, 2.4]), np.radians(92.0), np.radians(32.0)
    towards = np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    angle = {"type": "aoa", "station_id": "bs1", "azimuth_deg": 32.0, "zenith_deg": 92.0}
    angle |= {"azimuth_stdev_deg": 1.5, "zenith_stdev_deg": 1.5}
    length = {"type": "pt", "station_id": "bs1", "range_m": 10.0, "stdev_m": 2.0}

    def asked(**said: float) -> tuple[str, float]:
        """Status, and how far the position is from the straight ray, m."""
        answer = hall_app.post("/v1/positions", {"measurements": [angle | said, length]}).json()
        place = np.array([answer["position"][axis] for axis in "xyz"])
        return answer["status"], float(np.linalg.norm(np.cross(place - station, towards)))

    _, between = asked()
    assert 0.3 < between < 1.0  # the mean of both, or the nearer to the other's mean
    status, aside = asked(los_probability=1.0)
    assert status == "ok"
    assert aside < 0.2
    status, aside = asked(los_probability=0.0)
    assert status == "ok"
    assert aside > 1.0
