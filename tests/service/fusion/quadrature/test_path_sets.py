"""Sets of measured paths: the kernel against the sum over all assignments, and reports of them."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_service.fusion.measurements.report import MeasuredPath, Report
from rayfix_service.fusion.quadrature.detection import NO_CORNERS
from rayfix_service.fusion.quadrature.path_sets import CLOCK, NO_CLOCK, collapse_beams, extend_beams, new_beams
from rayfix_service.fusion.quadrature.sets import sort_paths
from rayfix_service.locator import Locator
from rayfix_service.wire import InvalidReportError, parse_report, report_to_document
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table
from tests.support.tables.mirrored_paths import AT, seen
from tests.support.tables.open_room import POSITIONS, mirrored_room_table


@pytest.fixture(scope="module")
def mirrored(tmp_path_factory: pytest.TempPathFactory) -> Table:
    return mirrored_room_table(tmp_path_factory.mktemp("room"))


STATION = Station(id="a", position=(0.0, 0.0, 0.0))
SITE = SiteInfo(name="one", north=0.0, max_path_length=40.0, stations=(STATION,))
IMAGES = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 6.0, 0.0]])
MIRRORS = np.array([np.eye(3), np.eye(3), np.diag([1.0, -1.0, 1.0])])
DETECTED = np.array([0.9, 0.6, 0.3])
PLACE = np.array([3.0, 2.0, 1.0])


def log_density(measured: list[MeasuredPath], offsets: NDArray[np.float64], spurious: float) -> float:
    """Sum over all assignments of measured paths to different paths, and integrate over the offset on a grid."""
    apart = PLACE - IMAGES
    length = np.linalg.norm(apart, axis=1)
    heading = np.einsum("nij,ni->nj", MIRRORS, apart / length[:, None])
    azimuth, zenith = np.arctan2(heading[:, 1], heading[:, 0]), np.arccos(heading[:, 2])
    detected, missed = DETECTED**0.5, (1.0 - DETECTED) ** 0.5
    total = np.zeros(len(offsets))
    for choice in itertools.product((-1, 0, 1, 2), repeat=len(measured)):
        used = [k for k in choice if k >= 0]
        if len(set(used)) < len(used):
            continue
        value = np.full(len(offsets), np.prod([missed[k] for k in range(len(used)) if k not in used]))
        for k, path in zip(choice, measured, strict=True):
            if k < 0:
                value *= spurious
                value /= 1.0 if path.azimuth is None else 2.0 * math.pi if path.zenith is None else 4.0 * math.pi
                if path.length is not None:
                    value /= SITE.max_path_length + math.sqrt(2.0 * math.pi) * path.stdev
                continue
            value *= detected[k]
            if path.azimuth is not None:
                value *= normal(path.azimuth - azimuth[k], path.azimuth_stdev)
            if path.zenith is not None:
                value *= normal(path.zenith - zenith[k], path.zenith_stdev) / math.sin(path.zenith)
            if path.length is not None:
                value *= normal(path.length - length[k] - offsets, path.stdev)
        total += value
    if len(offsets) == 1:
        return float(np.log(total[0]))
    return float(np.log(np.sum(total) * (offsets[1] - offsets[0]) / SITE.max_path_length))


def normal(error: NDArray[np.float64] | float, stdev: float | None) -> NDArray[np.float64]:
    assert stdev is not None
    return np.asarray(np.exp(-0.5 * (error / stdev) ** 2) / (math.sqrt(2.0 * math.pi) * stdev))


def evaluated(
    measured: list[MeasuredPath], spurious: float, *, detailed: bool = True
) -> tuple[float, NDArray[np.float64]]:
    """Log likelihood and who is spurious by the kernels, in a voxel or in a larger block."""
    found = sort_paths(list(enumerate(measured)), SITE, within_db=20.0, spurious_paths=spurious)
    one = found.groups[0][0][2]
    assert one.on_clock == (NO_CLOCK if measured[0].clock == "known" else CLOCK)
    paths = (
        np.array([0, 3]),
        np.arange(3, dtype=np.int32),
        DETECTED.astype(np.float32),
        np.zeros(0, np.float32),
        np.zeros(0, np.int8),
    )
    beams = tuple(new_beams(1))
    log, told, lost = np.zeros(1), np.zeros(1), np.zeros((len(measured), 1))
    whole = np.zeros(0, np.float32), NO_CORNERS, np.zeros(3), 1.0
    if detailed:
        whole = DETECTED.astype(np.float32), np.full((3, 8), 255, np.uint8), np.zeros(3), 8.0
    extend_beams(
        PLACE[None], np.zeros(1, np.int64), 1e-12, 1.0, 1.0, paths, whole, (IMAGES, MIRRORS), tuple(one), beams
    )
    collapse_beams(beams, log, told, one.bit, lost)
    return float(log[0]), lost[:, 0]


def noisy(rng: np.random.Generator, kinds: list[str], clock: str, offset: float) -> list[MeasuredPath]:
    """Measure the three paths, or what the kinds say of each: "az" and "ze" are angles, "L" is a length."""
    measured = []
    for k, kind in enumerate(kinds):
        apart = PLACE - IMAGES[k]
        length = float(np.linalg.norm(apart))
        x, y, z = MIRRORS[k].T @ apart / length
        path = MeasuredPath(station_id="a", clock=clock)  # type: ignore[arg-type]
        if "az" in kind:
            path = replace(path, azimuth=math.atan2(y, x) + 0.05 * rng.normal(), azimuth_stdev=0.05)
        if "ze" in kind:
            path = replace(path, zenith=math.acos(z) + 0.04 * rng.normal(), zenith_stdev=0.04)
        if "L" in kind:
            path = replace(path, length=length + offset + 0.2 * rng.normal(), stdev=0.2)
        measured.append(path)
    return measured


@pytest.mark.parametrize("clock", ["known", "ue", "station"])
@pytest.mark.parametrize("kinds", [["azzeL"] * 3, ["azL", "azzeL", "L"], ["azzeL", "azzeL"], ["L", "L", "L"]])
def test_the_beam_is_the_sum_over_all_assignments(clock: str, kinds: list[str]) -> None:
    rng = np.random.default_rng(11)
    for _ in range(5):
        offset = 0.0 if clock == "known" else 7.0
        measured = noisy(rng, kinds, clock, offset)
        # Times on the UE's clock count from the first one; a flat offset does not mind.
        offsets = np.zeros(1) if clock == "known" else np.arange(-20.0, 30.0, 0.01)
        found, _ = evaluated(measured, 0.3)
        assert found == pytest.approx(log_density(measured, offsets, 0.3), abs=2e-3)


def test_a_large_block_is_as_good_where_little_is_open() -> None:
    """It keeps fewer assignments, which do where directions tell the paths apart."""
    measured = noisy(np.random.default_rng(2), ["azzeL", "azzeL"], "ue", 5.0)[1:]
    measured += noisy(np.random.default_rng(6), ["azzeL"] * 3, "ue", 5.0)[2:]
    found, _ = evaluated(measured, 1e-3, detailed=False)
    assert found == pytest.approx(log_density(measured, np.arange(-20.0, 30.0, 0.01), 1e-3), abs=0.02)


def test_two_measurements_of_one_path_count_once() -> None:
    """The direct path measured twice: one of the two is spurious, or of the path half a metre aside."""
    rng = np.random.default_rng(3)
    once = noisy(rng, ["azzeL"], "known", 0.0)[0]
    twice = [once, replace(once, length=once.length + 0.01)]  # type: ignore[operator]
    both, lost = evaluated(twice, 1e-4)
    assert both == pytest.approx(log_density(twice, np.zeros(1), 1e-4), abs=2e-3)
    assert lost.sum() < 1.0


def test_a_path_from_nowhere_is_spurious() -> None:
    measured = noisy(np.random.default_rng(4), ["azzeL"] * 2, "ue", 5.0)
    measured.append(replace(measured[0], azimuth=-2.0, length=measured[0].length + 11.0))  # type: ignore[operator]
    _, lost = evaluated(measured, 0.3)
    np.testing.assert_allclose(lost, [0.0, 0.0, 1.0], atol=1e-3)


def test_hypotheses_that_are_left_out_hardly_matter() -> None:
    """Lengths alone fit several paths: of more assignments than are kept, the best stand for all to half a per cent."""
    measured = noisy(np.random.default_rng(5), ["L"] * 3, "ue", 5.0)
    found, _ = evaluated(measured, 3.0)
    assert found == pytest.approx(log_density(measured, np.arange(-20.0, 30.0, 0.01), 3.0), abs=5e-3)


@pytest.mark.parametrize(("clock", "offset"), [("range_m", 0.0), ("toa_m", 1234.5), ("delay_ns", 0.0)])
def test_one_station_locates_by_two_paths(mirrored: Table, clock: str, offset: float) -> None:
    """Two directions of one station and the difference of the lengths are enough, whatever the clock shows."""
    fix = Locator(mirrored).locate({"measurements": seen("a", clock, offset)})
    assert fix.status == "ok"
    assert fix.position is not None
    assert np.linalg.norm(fix.position - AT) < 0.1
    assert all((outcome.outlier_probability or 0.0) < 0.05 for outcome in fix.outcomes)


def test_many_sharp_paths_find_a_place_that_large_blocks_hide(mirrored: Table) -> None:
    """Of eight paths, the posterior is 500 times smaller than the blocks in which the search begins."""
    locator, rng = Locator(mirrored), np.random.default_rng(21)
    for _ in range(8):
        place = rng.uniform([1.0, 1.0, 0.4], [5.0, 7.0, 2.2])
        rows: list[dict[str, object]] = []
        for name in POSITIONS:
            rows += [
                row | {"azimuth_stdev_deg": 0.1, "zenith_stdev_deg": 0.1, "stdev_m": 0.02}
                for row in seen(name, "toa_m", 12.0, place)
            ]
        fix = locator.locate({"measurements": rows})
        assert fix.position is not None
        np.testing.assert_allclose(fix.position, place, atol=0.02)


def test_the_clock_is_common_to_all_stations(mirrored: Table) -> None:
    """Times of one path of each of four stations, without angles, leave no more open than differences do."""
    rows = [
        {key: value for key, value in seen(name, "toa_m", 77.0)[0].items() if key in ("type", "station_id", "toa_m")}
        | {"stdev_m": 0.1}
        for name in POSITIONS
    ]
    report: dict[str, object] = {"measurements": rows, "height": {"z_m": 1.2, "stdev_m": 0.05}}
    fix = Locator(mirrored).locate(report)
    assert fix.position is not None
    assert np.linalg.norm(fix.position - AT) < 0.2
    own = [{**row, "toa_m": row["toa_m"] + 3.0 * n} for n, row in enumerate(rows)]  # type: ignore[operator]
    other = Locator(mirrored).locate({**report, "measurements": own})
    assert other.log_evidence < fix.log_evidence - 3.0


def test_what_cannot_be_together_is_refused(mirrored: Table) -> None:
    locator = Locator(mirrored)
    rows = seen("a", "toa_m")
    with pytest.raises(ReportError, match="on another clock"):
        locator.locate({"measurements": [rows[0], seen("a", "range_m")[1]]})
    many = [{**rows[0], "toa_m": 9.0 + 0.1 * n} for n in range(63)]
    with pytest.raises(ReportError, match="give at most 62, the strongest"):
        locator.locate({"measurements": many})


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"stdev_m": None}, "stdev_m"),
        ({"range_m": 3.0}, "toa_m"),
        ({"azimuth_deg": None, "azimuth_stdev_deg": None}, "azimuth_deg"),
        ({"zenith_stdev_deg": None}, "zenith_stdev_deg"),
        ({"stdev_ns": 1.0}, "stdev_ns"),
    ],
)
def test_bad_paths_are_refused(change: dict[str, object], path: str) -> None:
    with pytest.raises(InvalidReportError) as caught:
        parse_report({"measurements": [seen("a", "toa_m")[0] | change]})
    assert caught.value.problems[0].path[:2] == ("measurements", 0)
    assert caught.value.problems[0].path[-1] == path


def test_paths_come_back_from_their_json() -> None:
    rows = [{**row, "power_db": -61.0} for row in seen("a", "delay_ns")]
    first, again = parse_report({"measurements": rows}), None
    again = parse_report(report_to_document(first))
    for mine, other in zip(first.measurements, again.measurements, strict=True):
        for name in ("azimuth", "zenith", "length", "stdev", "azimuth_stdev"):
            assert getattr(mine, name) == pytest.approx(getattr(other, name), rel=1e-12)
        assert replace(mine, azimuth=0, zenith=0, length=0, stdev=1, azimuth_stdev=1, zenith_stdev=1) == replace(  # type: ignore[type-var]
            other, azimuth=0, zenith=0, length=0, stdev=1, azimuth_stdev=1, zenith_stdev=1
        )


def test_paths_built_in_python_are_checked(mirrored: Table) -> None:
    path = MeasuredPath(station_id="a", azimuth=0.5, azimuth_stdev=0.02, zenith=1.8)
    with pytest.raises(ReportError, match="zenith_stdev"):
        Locator(mirrored).locate(Report(measurements=(path,)))
    with pytest.raises(ReportError, match="azimuth"):
        Locator(mirrored).locate(Report(measurements=(MeasuredPath(station_id="a"),)))
