"""Simulated reports of the bundled hall: the beam against the exhaustive product, outliers, what must not matter."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_evaluation.drops.simulate import Noise, Timing, simulate_report, uniform_drops
from rayfix_evaluation.truth.forward import ForwardSolver, Paths
from rayfix_service.fusion.measurements.observations import sort_report
from rayfix_service.fusion.measurements.report import (
    Angle,
    Frame,
    Measurement,
    Range,
    Report,
    TimeDifference,
    TimeOfArrival,
)
from rayfix_service.fusion.posterior.fix import Candidate, Fix
from rayfix_service.fusion.product.beam import multiply
from rayfix_service.fusion.product.factor_kernels import TIME_OUTLIER
from rayfix_service.fusion.product.factors import Factor, make_factor
from rayfix_service.fusion.product.information_form import unpack
from rayfix_service.fusion.product.prior import Prior, uniform_prior
from rayfix_service.fusion.product.station_mixture import StationMixtures
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report
from rayfix_tables.geometry.angles import angles_of, direction, local_to_scene
from rayfix_tables.table import Table
from tests.support.oracles import kernel_twins

Array = NDArray[np.float64]

TIMINGS: tuple[Timing, ...] = ("none", "pt", "toa")
DEFAULT = FusionSettings()


@dataclass(frozen=True, kw_only=True)
class Drop:
    """A place in the hall and the paths to it of the stations that hear it."""

    position: Array
    paths: dict[str, Paths]


@dataclass(frozen=True, kw_only=True)
class Hall:
    """A table of the hall, and a hundred places there which at least two stations hear."""

    table: Table
    locator: Locator
    drops: list[Drop]

    def report(self, n: int, timing: Timing, stdev_deg: float = 1.0) -> Report:
        """Report of the n-th place."""
        stdev = math.radians(stdev_deg)
        noise = Noise(azimuth_stdev=stdev, zenith_stdev=stdev, range_stdev=0.5)
        rng = np.random.default_rng([n, 7])
        return parse_report(simulate_report(self.drops[n].paths, noise, rng=rng, timing=timing))


@pytest.fixture(scope="module")
def hall(hall_table_path: Path) -> Hall:
    table = Table.open(hall_table_path)
    solver = ForwardSolver.from_mesh(table.scene.vertices, table.scene.faces, max_reflections=2)
    stations = {station.id: solver.station(station.position) for station in table.site.stations}
    rng = np.random.default_rng(1)
    places = uniform_drops(table.scene.free_space.contains, [0.2, 0.2, 0.2], [7.8, 17.8, 2.3], 130, rng)
    drops = []
    for place in places:
        paths = {name: station.paths(place) for name, station in stations.items()}
        heard = {name: found for name, found in paths.items() if len(found)}
        if len(heard) > 1:
            drops.append(Drop(position=place, paths=heard))
    assert len(drops) >= 100
    return Hall(table=table, locator=Locator(table), drops=drops[:100])


def best(fix: Fix) -> Candidate:
    return fix.candidates[0]


def assert_same(fix: Fix, expected: Fix, tolerance: float) -> None:
    """Compare positions [m], probabilities and statuses."""
    assert fix.status == expected.status
    assert len(fix.candidates) == len(expected.candidates)
    for one, other in zip(fix.candidates, expected.candidates, strict=True):
        np.testing.assert_allclose(one.position, other.position, rtol=0, atol=tolerance)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=0, atol=tolerance)
        assert one.probability == pytest.approx(other.probability, abs=tolerance)


def factors_of(hall: Hall, report: Report, most: int, place: Array) -> tuple[list[Factor], int]:
    """Factors of a report, of each the ``most`` best alternatives and the outlier; and the number of clocks.

    The best are those that are likely within half a metre or so of a place: the alternatives of all stations then
    agree, as those of a whole report do.
    """
    sorted_report = sort_report(report, hall.table.site)
    log_volume = float(np.log(hall.table.scene.free_space.volume))
    log_range = np.log(hall.table.site.max_path_length)
    factors = []
    for observation in sorted_report.observations:
        factor = make_factor(
            observation,
            StationMixtures(hall.table.parts[observation.station_id]),
            num_clocks=sorted_report.num_clocks,
            max_path_length=hall.table.site.max_path_length,
            prior=Prior(log_volume=log_volume),
            settings=replace(DEFAULT, max_divergence=0.0),
        )
        assert factor is not None
        near = np.diag([*np.full(3, 0.5**-2), *np.zeros(sorted_report.num_clocks)])
        information, eta, log_scale = unpack(factor.columns)
        score = kernel_twins.log_integral(
            information + near, eta + near[:, :3] @ place, log_scale, log_volume, log_range
        )
        keep = np.sort(np.concatenate([np.argsort(-score[:-1])[:most], [len(factor) - 1]]))
        factors.append(Factor(columns=factor.columns[:, keep], outlier=factor.outlier[keep]))
    return factors, sorted_report.num_clocks


def exhaustive(hall: Hall, factors: list[Factor], num_clocks: int) -> tuple[Array, Array, Array]:
    """Log weights, the best first, mean positions and covariances of all products that tell of the position."""
    log_volume = float(np.log(hall.table.scene.free_space.volume))
    log_range = float(np.log(hall.table.site.max_path_length))
    size = 3 + num_clocks
    information, eta = np.zeros((1, size, size)), np.zeros((1, size))
    log_scale, score = np.full(1, -log_volume - num_clocks * log_range), np.zeros(1)
    for factor in factors:
        alternatives = unpack(factor.columns)
        parent, choice, score = kernel_twins.extend_beam(
            information, eta, log_scale, *alternatives, log_volume, log_range
        )
        information = information[parent] + alternatives[0][choice]
        eta, log_scale = eta[parent] + alternatives[1][choice], log_scale[parent] + alternatives[2][choice]
    placed = information[:, 0, 0] > 0.0
    information, eta = information[placed], eta[placed]
    unknown = np.diagonal(information, axis1=1, axis2=2) <= 0.0
    cov = np.asarray(np.linalg.inv(information + unknown[:, None] * np.eye(size)), np.float64)
    return score[placed], np.einsum("hij,hj->hi", cov, eta)[:, :3], cov[:, :3, :3]


@pytest.mark.parametrize("timing", TIMINGS)
def test_the_beam_finds_what_the_exhaustive_product_finds(hall: Hall, timing: Timing) -> None:
    """All of some 40 000 products of the twelve best alternatives of each station, for every third place.

    Without merging a beam that is wide enough keeps all of them that can matter. The default one merges: mostly a
    thousandth of a nat and of the posterior's width is lost; at worst hundredths of a nat, and a tenth of the width.
    """
    evidence_errors, shifts = [], []
    for n in range(TIMINGS.index(timing), 100, 3):
        factors, num_clocks = factors_of(hall, hall.report(n, timing), 12, hall.drops[n].position)
        log_weight, mean, cov = exhaustive(hall, factors, num_clocks)
        log_sum = np.logaddexp.reduce(log_weight)
        share = np.exp(log_weight - log_sum)
        whole_mean = share @ mean
        products = partial(
            multiply,
            factors,
            max_path_length=hall.table.site.max_path_length,
            prior=uniform_prior(hall.table.scene.free_space),
        )
        whole = products(width=len(log_weight) + 1, max_divergence=0.0)
        # What the beam gives up is 20 nats below the best before the last factor is known.
        likely = int((share > 1e-4).sum())
        np.testing.assert_allclose(whole.log_weight[:likely], log_weight[:likely], rtol=0, atol=1e-6)  # nats
        kept = np.exp(whole.log_weight - log_sum)
        assert kept.sum() == pytest.approx(1.0, abs=1e-4)
        np.testing.assert_allclose(kept @ whole.mean, whole_mean, rtol=0, atol=1e-3)  # m
        beam = products(width=DEFAULT.beam_width, max_divergence=DEFAULT.max_divergence)
        kept = np.exp(beam.log_weight - log_sum)
        width = math.sqrt(share @ (np.trace(cov, axis1=1, axis2=2) + ((mean - whole_mean) ** 2).sum(axis=1)))  # m
        evidence_errors.append(abs(math.log(kept.sum())))
        shifts.append(np.linalg.norm(kept @ beam.mean / kept.sum() - whole_mean) / width)
    assert max(evidence_errors) < 0.08  # nats
    assert np.median(evidence_errors) < 1e-3
    assert max(shifts) < 0.15  # of the posterior's standard deviation
    assert np.median(shifts) < 2e-3


@pytest.mark.parametrize("timing", TIMINGS)
def test_a_wider_beam_without_merging_gives_the_same_fix(hall: Hall, timing: Timing) -> None:
    """And the whole posterior is nearly the same: its divergence (Kullback-Leibler), by samples.

    A shoulder of a mode may just be a mode by itself or just be none; mostly the modes are the same.
    """
    wide = Locator(hall.table, FusionSettings(beam_width=8192, max_divergence=0.0))
    same_modes = 0
    for n in range(0, 100, 12):
        report = hall.report(n, timing)
        fix, expected = hall.locator.locate(report), wide.locate(report)
        assert fix.log_evidence == pytest.approx(expected.log_evidence, abs=0.1)
        assert fix.regions is not None
        assert expected.regions is not None
        assert fix.regions.horizontal_radius(0.68) == pytest.approx(expected.regions.horizontal_radius(0.68), rel=0.1)
        posterior = wide.posterior(report)
        drawn = posterior.sample(300, np.random.default_rng(n))
        lost = posterior.log_density(drawn) - hall.locator.posterior(report).log_density(drawn)
        assert lost.mean() < 0.05  # nats
        modes = [sum(candidate.probability > 0.03 for candidate in one.candidates) for one in (fix, expected)]
        if modes[0] == modes[1]:
            same_modes += 1
            assert fix.status == expected.status
            assert best(fix).probability == pytest.approx(best(expected).probability, abs=0.04)
            assert np.linalg.norm(best(fix).position - best(expected).position) < 0.01  # m
    assert same_modes >= 6  # of nine


def test_however_many_times_a_path_has_they_may_be_outliers(hall: Hall) -> None:
    """A station with a time of arrival and two time differences, which are on two clocks."""
    report = next(r for r in (hall.report(n, "toa") for n in range(100)) if len(r.measurements) == 8)
    first, *others = {m.station_id: m for m in report.measurements}
    differences = [
        TimeDifference(station_id=first, reference_station_id=name, length_difference=1.0, stdev=0.5)
        for name in others[:2]
    ]
    crowded = Report(measurements=(*report.measurements, *differences))
    (factor, *_), num_clocks = factors_of(hall, crowded, 1000, hall.drops[0].position)
    assert num_clocks == 2
    assert np.count_nonzero(factor.outlier == TIME_OUTLIER) > 10


@pytest.mark.parametrize("timing", TIMINGS)
def test_the_order_of_the_measurements_does_not_matter(hall: Hall, timing: Timing) -> None:
    rng = np.random.default_rng(3)
    for n in range(100):
        report = hall.report(n, timing)
        order = rng.permutation(len(report.measurements))
        shuffled = Report(measurements=tuple(report.measurements[i] for i in order))
        expected, fix = hall.locator.locate(report), hall.locator.locate(shuffled)
        assert_same(fix, expected, 1e-9)
        for place, i in enumerate(order):
            mine, same = fix.outcomes[place], expected.outcomes[i]
            assert mine.outlier_probability == pytest.approx(same.outlier_probability, abs=1e-9)


def test_the_clock_and_the_reference_do_not_matter(hall: Hall) -> None:
    for n in range(0, 100, 9):
        report = hall.report(n, "toa")
        expected = hall.locator.locate(report)
        arrivals = [m for m in report.measurements if isinstance(m, TimeOfArrival)]
        angles = [m for m in report.measurements if isinstance(m, Angle)]
        late = [replace(m, path_length=m.path_length - 2000.0) for m in arrivals]
        assert_same(hall.locator.locate(Report(measurements=(*angles, *late))), expected, 1e-9)
        for at_reference in arrivals:
            differences = [
                TimeDifference(
                    station_id=m.station_id,
                    reference_station_id=at_reference.station_id,
                    length_difference=m.path_length - at_reference.path_length,
                    stdev=math.sqrt(2.0) * m.stdev,
                )
                for m in arrivals
                if m is not at_reference
            ]
            assert_same(hall.locator.locate(Report(measurements=(*angles, *differences))), expected, 1e-6)


def test_the_frame_does_not_matter(hall: Hall) -> None:
    """Noise that is a circle on the sphere, so that it is as simple in every frame."""
    orientations = [(0.7, 0.2, -0.1), (2.5, -0.3, 0.4), (-2.0, 0.1, 0.2), (-1.0, 0.5, 0.0)]
    stations = tuple(
        replace(station, orientation=orientation)
        for station, orientation in zip(hall.table.site.stations, orientations, strict=True)
    )
    site = replace(hall.table.site, north=1.1, stations=stations)
    locator = Locator(replace(hall.table, site=site))
    rotations = {station.id: local_to_scene(station.orientation) for station in stations}
    north = local_to_scene((1.1, 0.0, 0.0))

    def seen_in(frame: Frame, angle: Angle) -> Angle:
        rotation = {"scene": np.eye(3), "north": north, "lcs": rotations[angle.station_id]}[frame]
        assert angle.zenith is not None
        azimuth, zenith = angles_of(rotation.T @ direction(angle.azimuth, angle.zenith))
        return replace(
            angle,
            azimuth=float(azimuth),
            zenith=float(zenith),
            azimuth_stdev=math.radians(1.5) / math.sin(zenith),
            zenith_stdev=math.radians(1.5),
            frame=frame,
        )

    for n in range(0, 100, 12):
        fixes = []
        frames: tuple[Frame, ...] = ("scene", "north", "lcs")
        for frame in frames:
            measurements = hall.report(n, "pt").measurements
            turned = (seen_in(frame, m) if isinstance(m, Angle) else m for m in measurements)
            fixes.append(locator.locate(Report(measurements=tuple(turned))))
        assert_same(fixes[1], fixes[0], 1e-6)
        assert_same(fixes[2], fixes[0], 1e-6)


def without(report: Report, station_id: str) -> Report:
    return Report(measurements=tuple(m for m in report.measurements if m.station_id != station_id))


def test_what_cannot_be_used_leaves_the_fix_of_the_others(hall: Hall) -> None:
    """The angle of bs1 lies outside of its field of view, then in a cell that no ray reaches."""
    report = next(r for r in (hall.report(n, "none") for n in range(100)) if len(r.measurements) == 4)
    angle = report.measurements[0]
    assert isinstance(angle, Angle)
    assert angle.station_id == "bs1"
    expected = hall.locator.locate(without(report, "bs1"))
    station = replace(hall.table.site.stations[0], orientation=(angle.azimuth + 2.0, 0.0, 0.0), field_of_view=1.0)
    site = replace(hall.table.site, stations=(station, *hall.table.site.stations[1:]))
    part = hall.table.parts["bs1"]
    levels = []
    for level in part.levels:
        assert angle.zenith is not None
        cell = int(level.grid.nearest(angle.azimuth, angle.zenith))
        offsets = level.cell_offsets.copy()
        offsets[cell + 1] = offsets[cell]
        levels.append(replace(level, cell_offsets=offsets))
    parts = {**hall.table.parts, "bs1": replace(part, levels=tuple(levels))}
    for table, reason in [
        (replace(hall.table, site=site), "the angle lies outside the field of view of station 'bs1'"),
        (replace(hall.table, parts=parts), "no ray of station 'bs1' comes from that direction"),
    ]:
        fix = Locator(table).locate(report)
        assert_same(fix, expected, 1e-9)
        first, *others = fix.outcomes
        assert (first.used, first.outlier_probability, first.reason) == (False, None, reason)
        assert all(other.used and other.reason is None for other in others)
        nothing = Locator(table).locate(Report(measurements=(angle,)))
        assert (nothing.status, nothing.candidates, nothing.position) == ("insufficient", (), None)


def test_a_single_time_of_arrival_is_not_used(hall: Hall) -> None:
    fix = hall.locator.locate(
        Report(
            measurements=(TimeOfArrival(station_id="bs1", path_length=5.0, stdev=0.5),), target_id="t", timestamp="s"
        )
    )
    assert (fix.status, fix.candidates) == ("insufficient", ())
    assert (fix.target_id, fix.timestamp, fix.table_id) == ("t", "s", hall.table.table_id)
    assert "unknown" in str(fix.outcomes[0].reason)


def test_a_range_longer_than_any_path_contradicts_the_table(hall: Hall) -> None:
    fix = hall.locator.locate(Report(measurements=(Range(station_id="bs1", path_length=5e4, stdev=0.5),)))
    assert (fix.status, fix.candidates) == ("inconsistent", ())
    assert fix.outcomes[0].outlier_probability == pytest.approx(1.0)


def test_no_region_is_larger_than_the_building(hall: Hall) -> None:
    """A time of 4 us beside an angle gave a radius of 1.8 km: nanoseconds for metres are a common mistake."""
    angle = Angle(station_id="bs1", azimuth=0.9, zenith=1.7, azimuth_stdev=0.02, zenith_stdev=0.02)
    fix = hall.locator.locate(Report(measurements=(angle, Range(station_id="bs1", path_length=1200.0, stdev=1.5))))
    assert fix.status == "inconsistent"
    assert fix.regions is not None
    across = math.hypot(8.0, 18.0)
    assert 0.5 * across < fix.regions.horizontal_radius(0.68) < across + 0.5
    assert fix.regions.vertical_half_height(0.68) < 2.8
    assert np.sqrt(np.diag(best(fix).covariance)).max() < 18.5
    usual = hall.locator.locate(hall.report(0, "toa")).regions
    assert usual is not None
    assert usual.horizontal_radius(0.68) < 1.0


def test_one_wide_angle_alone_is_no_position(hall: Hall) -> None:
    """It may have come from half of the hall, which is one mode wider than a position may be."""
    stdev = math.radians(40.0)
    for station_id, azimuth in [("bs1", 0.9), ("bs2", 2.2), ("bs3", -2.2), ("bs4", -0.9)]:
        angle = Angle(station_id=station_id, azimuth=azimuth, zenith=1.7, azimuth_stdev=stdev, zenith_stdev=stdev)
        fix = hall.locator.locate(Report(measurements=(angle,)))
        assert fix.status == "insufficient"
        assert np.sqrt(np.linalg.eigvalsh(best(fix).covariance)[-1]) > 3.0


@pytest.mark.parametrize(("stdev_deg", "within"), [(0.05, 0.1), (25.0, 3.0)])
def test_from_the_best_angles_to_the_worst(hall: Hall, stdev_deg: float, within: float) -> None:
    """Angles of a laser, and of a room's corner: half of the fixes are that near, and they know how near they are."""
    apart, known = [], []
    for n in range(0, 100, 3):
        candidate = best(hall.locator.locate(hall.report(n, "pt", stdev_deg)))
        error = candidate.position - hall.drops[n].position
        apart.append(float(np.linalg.norm(error)))
        known.append(error @ np.linalg.solve(candidate.covariance, error) < 16.0)
    assert np.median(apart) < within
    assert np.mean(known) > 0.7


def test_a_station_that_reports_nonsense_is_told_and_left_out(hall: Hall) -> None:
    """A random angle and a range 10 m too long from one of four stations."""
    rng = np.random.default_rng(5)
    told, apart = [], []
    for n in range(100):
        report = hall.report(n, "pt")
        names = sorted({m.station_id for m in report.measurements})
        if len(names) < 4:
            continue
        liar = names[n % 4]

        def lie(m: Measurement) -> Measurement:
            if isinstance(m, Angle):
                zenith = float(np.arccos(rng.uniform(-1.0, 0.5)))
                return replace(m, azimuth=float(rng.uniform(-np.pi, np.pi)), zenith=zenith)
            return replace(m, path_length=m.path_length + 10.0) if isinstance(m, Range) else m

        lies = [lie(m) if m.station_id == liar else m for m in report.measurements]
        fix = hall.locator.locate(Report(measurements=tuple(lies)))
        bad = {m.station_id for m, o in zip(lies, fix.outcomes, strict=True) if (o.outlier_probability or 0.0) > 0.5}
        told.append(bad == {liar})
        expected = hall.locator.locate(without(report, liar))
        apart.append(np.linalg.norm(best(fix).position - best(expected).position))
    assert len(told) > 20
    assert np.mean(told) > 0.8
    assert np.mean(np.array(apart) < 0.1) > 0.8  # m
