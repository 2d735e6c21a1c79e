"""Selection-aware reweighting: weights of a rule against closed forms, and what reports make of a rule."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.quadrature.blocks import BlockPaths, BlockTree
from rayfix_service.fusion.quadrature.reweighted import Reweighted
from rayfix_service.fusion.quadrature.selection import heaviest_first, none_before, selected_paths
from rayfix_service.fusion.quadrature.spread import spread_paths
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.fusion.stopping import FixStoppedError, Stop
from rayfix_service.locator import Locator
from rayfix_service.wire import InvalidReportError, parse_report, report_to_document
from rayfix_tables.errors import ReportError
from rayfix_tables.site import Selection
from rayfix_tables.table import Table
from tests.support.tables.one_voxel import LENGTHS, one_voxel
from tests.support.tables.open_room import POSITIONS, direct_paths, mirrored_room_table, open_room_table, room_space


def by_sequence(paths: BlockPaths, count: int = 3) -> NDArray[np.float64]:
    """Weights in the order of the sequences; those that are left out are 0."""
    found = np.zeros(count)
    found[paths.sequence] = paths.weight
    return found


def test_strongest_is_the_gain_to_a_power() -> None:
    paths = one_voxel([1.0, 0.5, 1.0], [0.0, -2.0, 0.0])
    gain = np.exp([0.0, -2.0, 0.0]) / LENGTHS**2
    expected = np.array([1.0, 0.5, 1.0]) * gain**1.5
    found = selected_paths(paths, Selection(rule="strongest", exponent=1.5))
    np.testing.assert_allclose(by_sequence(found), expected / expected.sum(), rtol=1e-3)
    assert np.all(np.diff(found.weight) <= 0.0)


def test_first_is_the_earliest_that_reaches_the_place() -> None:
    """Each path reaches half of the voxel, whatever the others do: 1/2, 1/4, 1/8 in the order of their lengths."""
    found = selected_paths(one_voxel([0.5, 0.5, 0.5], [0.0, 0.0, 0.0]), Selection(rule="first", within_db=60.0))
    np.testing.assert_allclose(by_sequence(found), np.array([1.0, 4.0, 2.0]) / 7.0, rtol=1e-3)


def test_any_takes_audible_paths_alike() -> None:
    """The path of 8 m is 12 dB weaker than that of 2 m by its length, and 60 dB by its walls in the second map."""
    loud, faint = (selected_paths(one_voxel([1.0, 1.0, 0.5], [g, 0.0, 0.0]), Selection(rule="any")) for g in (0, -13.8))
    np.testing.assert_allclose(by_sequence(loud), [0.4, 0.4, 0.2], rtol=1e-3)
    np.testing.assert_allclose(by_sequence(faint)[1:], [2.0 / 3.0, 1.0 / 3.0], atol=1e-3)
    assert by_sequence(faint)[0] < 1e-3


def test_spreading_against_dictionaries() -> None:
    """Each voxel gets a tenth of the mean of the voxels around it in which anything is heard."""
    space = room_space()
    paths = direct_paths((0.1, 0.1, 2.8), space)
    rng = np.random.default_rng(5)
    shape, counts = (4, 3, 2), rng.integers(0, 4, 24)
    sequence = np.concatenate([rng.permutation(5)[:n] for n in counts]).astype(np.int32)
    lit = rng.uniform(0.1, 1.0, len(sequence)).astype(np.float16)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    some = replace(
        paths,
        shape=shape,
        offsets=offsets,
        sequence=sequence,
        weight=np.ones(len(sequence), np.float32),
        log_gain=-np.arange(len(sequence)).astype(np.float16),
        lit=lit,
        images=rng.normal(size=(5, 3)),
    )
    found = spread_paths(some)
    lists = [dict(zip(sequence[a:b].tolist(), lit[a:b].astype(float), strict=True)) for a, b in pairwise(offsets)]
    for voxel in range(24):
        at = np.array(np.unravel_index(voxel, shape))
        around = [
            other
            for other in range(24)
            if other != voxel and counts[other] and np.abs(np.array(np.unravel_index(other, shape)) - at).max() == 1
        ]
        expected = {s: 0.9 * share for s, share in lists[voxel].items()}
        for other in around:
            for s, share in lists[other].items():
                expected[s] = expected.get(s, 0.0) + 0.1 * share / len(around)
        own = slice(found.offsets[voxel], found.offsets[voxel + 1])
        actual = dict(zip(found.sequence[own].tolist(), found.lit[own].astype(float), strict=True))
        assert actual == pytest.approx(expected, rel=2e-3)


def test_kernels_against_numpy() -> None:
    rng = np.random.default_rng(8)
    offsets = np.concatenate([[0], np.cumsum(rng.integers(0, 6, 40))])
    count = int(offsets[-1])
    voxel = np.repeat(np.arange(40), np.diff(offsets))
    weight = rng.random(count)
    kept = np.flatnonzero(weight > 0.2)
    expected = kept[np.lexsort((-weight[kept], voxel[kept]))]
    new_offsets, order = heaviest_first(offsets, weight, 0.2)
    np.testing.assert_array_equal(order, expected)
    np.testing.assert_array_equal(np.diff(new_offsets), np.bincount(voxel[expected], minlength=40))
    length, audible = rng.integers(1, 5, count).astype(float), rng.random(count)
    silent = [
        np.prod([1.0 - audible[m] for m in np.flatnonzero(voxel == voxel[n]) if (length[m], m) < (length[n], n)])
        for n in range(count)
    ]
    np.testing.assert_allclose(none_before(offsets, length, audible), silent, rtol=1e-12)


def test_a_rule_that_is_not_worked_out_yet_is_no_quick_fix(mirrored: Table) -> None:
    """The first report of a rule kept the event loop busy for seconds."""
    locator = Locator(mirrored)
    path = {"type": "path", "station_id": "a", "azimuth_deg": 45.0, "azimuth_stdev_deg": 1.0}
    for document in (reflected(rule="any"), reflected(rule="any", within_db=33.0), {"measurements": [path]}):
        report = parse_report(document)
        before = locator.seconds(report)
        locator.locate(report)
        after = locator.seconds(report)
        paths = mirrored.parts["a"].paths
        assert paths is not None
        assert before - after == pytest.approx(1.5e-6 * len(paths), rel=1e-6)


def test_a_stop_is_seen_between_the_weights_of_stations(mirrored: Table) -> None:
    stop = Stop()
    stop.set()
    locator, report = Locator(mirrored), parse_report(reflected(rule="first"))
    before = locator.seconds(report)
    with pytest.raises(FixStoppedError):
        locator.locate(report, stop=stop)
    assert locator.seconds(report) == before  # nothing was worked out


def test_weights_are_kept_for_the_rules_used_last() -> None:
    space = room_space()
    paths, tree = direct_paths((0.1, 0.1, 2.8), space), BlockTree(space, 2)
    kept = Reweighted(most=2)
    rules = [Selection(rule="any"), Selection(rule="first"), Selection(rule="any", within_db=10.0)]
    first = [kept.selected("a", paths, tree, rule) for rule in rules]
    assert len(kept) == 2
    assert kept.selected("a", paths, tree, rules[2]) is first[2]
    assert kept.selected("a", paths, tree, rules[0]) is not first[0]


@pytest.fixture(scope="module")
def mirrored(tmp_path_factory: pytest.TempPathFactory) -> Table:
    return mirrored_room_table(tmp_path_factory.mktemp("room"))


PLACE = np.array([3.0, 4.0, 1.2])


def reflected(**selection: object) -> dict[str, object]:
    """Return the report of station a on the path by the wall, and its rule."""
    apart = PLACE - np.array([12.0 - POSITIONS["a"][0], *POSITIONS["a"][1:]])
    length = float(np.linalg.norm(apart))
    x, y, z = apart * np.array([-1.0, 1.0, 1.0]) / length
    angle = {"azimuth_deg": math.degrees(math.atan2(y, x)), "zenith_deg": math.degrees(math.acos(z))}
    angle |= {"azimuth_stdev_deg": 1.0, "zenith_stdev_deg": 1.0}
    report: dict[str, object] = {
        "measurements": [
            {"type": "aoa", "station_id": "a", **angle},
            {"type": "pt", "station_id": "a", "range_m": length, "stdev_m": 0.1},
        ]
    }
    return report | ({"selection": selection} if selection else {})


def test_the_evidence_changes_as_the_weight_of_the_path_does(mirrored: Table) -> None:
    """At the place the path by the wall has the gain of its length, relative to the direct one."""
    locator = Locator(mirrored, FusionSettings(unmodelled_probability=0.0))
    either = locator.locate(reflected(rule="any"))
    assert either.position is not None
    assert np.linalg.norm(either.position - PLACE) < 0.05
    square = [float(((PLACE - np.array([x, *POSITIONS["a"][1:]])) ** 2).sum()) for x in (0.1, 11.9)]
    for exponent in (1.0, 3.0):
        strongest = locator.locate(reflected(rule="strongest", exponent=exponent))
        weight = square[1] ** -exponent / (square[0] ** -exponent + square[1] ** -exponent)
        assert either.log_evidence - strongest.log_evidence == pytest.approx(math.log(0.5 / weight), abs=0.06)
    # The direct path comes first everywhere, so that the angle is of it, and the range of nothing.
    first = locator.locate(reflected(rule="first"))
    assert first.position is not None
    assert np.linalg.norm(first.position - PLACE) > 1.0
    assert first.outcomes[1].outlier_probability == pytest.approx(1.0, abs=0.01)


def test_the_rule_of_a_station_holds_where_the_report_has_none(mirrored: Table) -> None:
    stations = tuple(replace(each, selection=Selection(rule="any")) for each in mirrored.site.stations)
    ruled = replace(mirrored, site=replace(mirrored.site, stations=stations))
    expected = Locator(mirrored).locate(reflected(rule="any")).log_evidence
    assert Locator(ruled).locate(reflected()).log_evidence == pytest.approx(expected, abs=1e-9)
    own = Locator(ruled).locate(reflected(rule="strongest", exponent=3.0)).log_evidence
    assert own < expected - 0.5


def test_what_a_rule_cannot_be_followed_for_is_said(mirrored: Table) -> None:
    """Times on a clock of unknown offset go by Gaussians, of which this table has none; the angle is not used."""
    report = reflected(rule="any")
    times = [{"type": "toa", "station_id": name, "range_m": 30.0, "stdev_m": 0.1} for name in ("a", "b")]
    fix = Locator(mirrored).locate({**report, "measurements": times})
    assert any("selection rule of a, b was not followed" in text for text in fix.simplified)


def test_a_table_without_gains_refuses_other_rules(tmp_path: Path) -> None:
    table = open_room_table(tmp_path / "t.h5")
    none = np.zeros(0, np.float16)
    parts = {
        name: replace(part, paths=replace(part.paths, lit=none, log_gain=none))  # type: ignore[type-var]
        for name, part in table.parts.items()
    }
    locator = Locator(replace(table, parts=parts))
    with pytest.raises(ReportError, match="build the table again"):
        locator.locate(reflected(rule="first"))
    own = locator.locate(reflected(rule="strongest"))  # is the table's, whose cells here are empty
    assert own.outcomes[0].reason == "no ray of station 'a' comes from that direction"


@pytest.mark.parametrize(
    ("selection", "path"),
    [
        ({"rule": "loudest"}, ("selection", "rule")),
        ({"rule": "first", "exponent": 2.0}, ("selection", "exponent")),
        ({"rule": "strongest", "within_db": 20.0}, ("selection", "within_db")),
        ({"rule": "any", "within_db": 0.0}, ("selection", "within_db")),
    ],
)
def test_bad_rules_are_refused(selection: dict[str, object], path: tuple[str, ...]) -> None:
    with pytest.raises(InvalidReportError) as caught:
        parse_report(reflected(**selection))
    assert caught.value.problems[0].path == path


@pytest.mark.parametrize(
    "selection", [{"rule": "strongest", "exponent": 3.0}, {"rule": "first"}, {"rule": "all", "within_db": 12.5}]
)
def test_rules_come_back_from_their_json(selection: dict[str, object]) -> None:
    report = parse_report(reflected(**selection))
    assert report_to_document(report)["selection"] == selection
    assert parse_report(report_to_document(report)).selection == report.selection
