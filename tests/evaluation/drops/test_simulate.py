"""Simulated reports: contract, noise and the selection of paths."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_evaluation.drops.simulate import (
    Noise,
    Rule,
    Timing,
    fold_direction,
    select_path,
    simulate_report,
    uniform_drops,
)
from rayfix_evaluation.truth.forward import Paths

DEGREE = np.pi / 180.0
NOISE = Noise(azimuth_stdev=1.0 * DEGREE, zenith_stdev=0.5 * DEGREE, range_stdev=0.5)
SILENT = Noise(azimuth_stdev=1e-14, zenith_stdev=1e-14, range_stdev=1e-14)
NO_PATHS: list[tuple[float, float, float, float]] = []


def paths_of(rows: list[tuple[float, float, float, float]]) -> Paths:
    """Make paths of rows (length, azimuth, zenith, gain); where they bounce does not matter here."""
    table = np.array(rows, dtype=float).reshape(-1, 4)
    return Paths(
        path_length=table[:, 0],
        azimuth=table[:, 1],
        zenith=table[:, 2],
        num_reflections=np.zeros(len(table), dtype=np.int64),
        gain_db=table[:, 3],
        vertices=np.zeros((len(table), 2, 3)),
        crossings=np.empty((len(table), 0, 3)),
        num_walls=np.zeros(len(table), np.int64),
    )


@pytest.fixture
def paths_by_station() -> dict[str, Paths]:
    """Three stations of which the first hears nothing; the strongest path of ``b`` is not its shortest."""
    return {
        "deaf": paths_of(NO_PATHS),
        "a": paths_of([(5.0, 0.5, 1.5, -14.0)]),
        "b": paths_of([(9.0, -2.0, 1.2, -20.0), (7.0, 3.1, 2.0, -23.0)]),
        "c": paths_of([(11.0, 1.0, 0.7, -21.0)]),
    }


def of_type(report: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [m for m in report["measurements"] if m["type"] == kind]


def test_report_has_the_fields_of_the_contract(paths_by_station: dict[str, Paths]) -> None:
    fields = {
        "aoa": {
            "type",
            "station_id",
            "azimuth_deg",
            "zenith_deg",
            "azimuth_stdev_deg",
            "zenith_stdev_deg",
            "frame",
        },
        "pt": {"type", "station_id", "range_m", "stdev_m"},
        "toa": {"type", "station_id", "range_m", "stdev_m"},
        "tdoa": {"type", "station_id", "reference_station_id", "range_difference_m", "stdev_m"},
    }
    timings: dict[Timing, list[str]] = {
        "none": ["aoa"] * 3,
        "pt": ["aoa"] * 3 + ["pt"] * 3,
        "toa": ["aoa"] * 3 + ["toa"] * 3,
        "tdoa": ["aoa"] * 3 + ["tdoa"] * 2,
    }
    for timing, kinds in timings.items():
        report = simulate_report(
            paths_by_station,
            NOISE,
            rng=np.random.default_rng(1),
            timing=timing,
            target_id="agv-7",
            timestamp="2026-01-31T10:00:00.250Z",
        )
        assert set(report) == {"target_id", "timestamp", "measurements"}
        assert (report["target_id"], report["timestamp"]) == ("agv-7", "2026-01-31T10:00:00.250Z")
        assert [m["type"] for m in report["measurements"]] == kinds
        for measurement in report["measurements"]:
            assert set(measurement) == fields[measurement["type"]]
        assert json.loads(json.dumps(report)) == report


def test_without_noise_the_report_is_the_geometry(paths_by_station: dict[str, Paths]) -> None:
    rng = np.random.default_rng(2)
    report = simulate_report(paths_by_station, SILENT, rng=rng, timing="pt")
    aoa = of_type(report, "aoa")
    assert [m["station_id"] for m in aoa] == ["a", "b", "c"]
    np.testing.assert_allclose([m["azimuth_deg"] * DEGREE for m in aoa], [0.5, -2.0, 1.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose([m["zenith_deg"] * DEGREE for m in aoa], [1.5, 1.2, 0.7], rtol=0, atol=1e-12)
    assert {m["frame"] for m in aoa} == {"scene"}
    pt = of_type(report, "pt")
    np.testing.assert_allclose([m["range_m"] for m in pt], [5.0, 9.0, 11.0], rtol=0, atol=1e-12)

    toa = of_type(simulate_report(paths_by_station, SILENT, rng=rng, timing="toa"), "toa")
    offsets = np.array([m["range_m"] for m in toa]) - [5.0, 9.0, 11.0]
    np.testing.assert_allclose(offsets, offsets[0], rtol=0, atol=1e-12)
    assert offsets[0] > 1.0  # this seed's clock is not right by chance

    tdoa = of_type(simulate_report(paths_by_station, SILENT, rng=rng, timing="tdoa"), "tdoa")
    assert [(m["station_id"], m["reference_station_id"]) for m in tdoa] == [("b", "a"), ("c", "a")]
    np.testing.assert_allclose([m["range_difference_m"] for m in tdoa], [4.0, 6.0], rtol=0, atol=1e-12)


def test_deviations_are_stated_in_the_contract_units(paths_by_station: dict[str, Paths]) -> None:
    rng = np.random.default_rng(3)
    report = simulate_report(paths_by_station, NOISE, rng=rng, timing="pt")
    for m in of_type(report, "aoa"):
        assert m["azimuth_stdev_deg"] == pytest.approx(1.0, abs=1e-12)
        assert m["zenith_stdev_deg"] == pytest.approx(0.5, abs=1e-12)
    assert [m["stdev_m"] for m in of_type(report, "pt")] == [0.5, 0.5, 0.5]
    tdoa = of_type(simulate_report(paths_by_station, NOISE, rng=rng, timing="tdoa"), "tdoa")
    assert [m["stdev_m"] for m in tdoa] == pytest.approx([np.sqrt(0.5)] * 2, abs=1e-12)


def draws(paths: dict[str, Paths], timing: Timing, count: int) -> NDArray[np.float64]:
    """Repeat a report of stations a, b, c: azimuths, zeniths (degrees) and times (m), one row a report."""
    rng = np.random.default_rng(4)
    rows = []
    for _ in range(count):
        report = simulate_report(paths, NOISE, rng=rng, timing=timing)
        aoa = of_type(report, "aoa")
        key = "range_difference_m" if timing == "tdoa" else "range_m"
        rows.append(
            [m["azimuth_deg"] for m in aoa] + [m["zenith_deg"] for m in aoa] + [m[key] for m in of_type(report, timing)]
        )
    return np.array(rows)


def test_noise_has_the_stated_deviations_and_is_independent(paths_by_station: dict[str, Paths]) -> None:
    count = 4000
    sample = draws(paths_by_station, "pt", count)
    truth = np.concatenate([np.degrees([0.5, -2.0, 1.0, 1.5, 1.2, 0.7]), [5.0, 9.0, 11.0]])
    stdev = np.repeat([1.0, 0.5, 0.5], 3)
    # Five standard errors of mean, deviation and correlation. The azimuth's is the same at each zenith.
    np.testing.assert_allclose(sample.mean(axis=0), truth, rtol=0, atol=5 * 1.0 / np.sqrt(count))
    np.testing.assert_allclose(sample.std(axis=0) / stdev, 1.0, rtol=0, atol=5 / np.sqrt(2 * count))
    np.testing.assert_allclose(np.corrcoef(sample.T), np.eye(9), rtol=0, atol=5 / np.sqrt(count))


def test_differences_share_the_noise_of_their_reference(paths_by_station: dict[str, Paths]) -> None:
    """Covariance of (b - a, c - a) with independent arrivals: s^2 [[2, 1], [1, 2]]."""
    count = 4000
    sample = draws(paths_by_station, "tdoa", count)[:, 6:]
    np.testing.assert_allclose(sample.mean(axis=0), [4.0, 6.0], rtol=0, atol=5 * 0.71 / np.sqrt(count))
    expected = 0.25 * np.array([[2.0, 1.0], [1.0, 2.0]])
    np.testing.assert_allclose(np.cov(sample.T), expected, rtol=0, atol=5 * 0.5 * np.sqrt(2 / count))


def test_clock_offset_changes_from_report_to_report(paths_by_station: dict[str, Paths]) -> None:
    sample = draws(paths_by_station, "toa", 200)[:, 6:] - [5.0, 9.0, 11.0]
    offsets = sample.mean(axis=1)
    assert offsets.std() == pytest.approx(300 / np.sqrt(12), rel=0.2)
    # Common to the stations of a report: what is left after it is the noise of single arrivals.
    left = sample - offsets[:, None]
    assert left.std() == pytest.approx(0.5 * np.sqrt(2 / 3), rel=0.15)


def test_equal_seeds_give_equal_noise_whatever_the_settings(paths_by_station: dict[str, Paths]) -> None:
    def report(noise: Noise, timing: Timing) -> dict[str, Any]:
        return simulate_report(paths_by_station, noise, rng=np.random.default_rng(5), timing=timing, rule="random")

    plain, timed = report(NOISE, "none"), report(NOISE, "pt")
    assert of_type(plain, "aoa") == of_type(timed, "aoa")
    ranges = {m["station_id"]: m["range_m"] for m in of_type(timed, "pt")}
    for m in of_type(report(NOISE, "tdoa"), "tdoa"):
        assert m["range_difference_m"] == pytest.approx(ranges[m["station_id"]] - ranges["a"], abs=1e-12)
    wide = Noise(azimuth_stdev=3 * NOISE.azimuth_stdev, zenith_stdev=NOISE.zenith_stdev, range_stdev=None)
    truth = np.degrees(0.5)
    narrow_error = of_type(plain, "aoa")[0]["azimuth_deg"] - truth
    wide_error = of_type(report(wide, "none"), "aoa")[0]["azimuth_deg"] - truth
    assert wide_error == pytest.approx(3 * narrow_error, abs=1e-9)


def test_rules_select_the_strongest_the_first_or_any() -> None:
    paths = paths_of([(9.0, 0, 1, -20.0), (7.0, 0, 1, -23.0), (8.0, 0, 1, -25.0)])
    rng = np.random.default_rng(6)
    assert select_path(paths, "strongest", rng) == 0
    assert select_path(paths, "first", rng) == 1
    counts = np.bincount([select_path(paths, "random", rng) for _ in range(3000)], minlength=3)
    np.testing.assert_allclose(counts, 1000, rtol=0, atol=5 * np.sqrt(3000 * 2 / 9))


@pytest.mark.parametrize(("rule", "length"), [("strongest", 9.0), ("first", 7.0)])
def test_report_follows_the_rule(paths_by_station: dict[str, Paths], rule: Rule, length: float) -> None:
    report = simulate_report(paths_by_station, SILENT, rng=np.random.default_rng(7), rule=rule, timing="pt")
    assert of_type(report, "pt")[1]["range_m"] == pytest.approx(length, abs=1e-12)


def test_nothing_heard_is_an_empty_report() -> None:
    timings: tuple[Timing, ...] = ("none", "pt", "toa", "tdoa")
    for timing in timings:
        report = simulate_report({"deaf": paths_of(NO_PATHS)}, NOISE, rng=np.random.default_rng(8), timing=timing)
        assert report["measurements"] == []


def test_one_station_alone_gives_no_difference() -> None:
    alone = {"a": paths_of([(5.0, 0.5, 1.5, -14.0)])}
    report = simulate_report(alone, NOISE, rng=np.random.default_rng(9), timing="tdoa")
    assert [m["type"] for m in report["measurements"]] == ["aoa"]


def test_noise_of_a_short_range_is_not_cut_off() -> None:
    near = {"a": paths_of([(0.1, 0.5, 1.5, 20.0)])}
    rng = np.random.default_rng(10)
    ranges = [of_type(simulate_report(near, NOISE, rng=rng), "pt")[0]["range_m"] for _ in range(200)]
    assert min(ranges) < -0.5
    assert np.mean(ranges) == pytest.approx(0.1, abs=5 * 0.5 / np.sqrt(200))


def test_noise_across_a_pole_or_the_seam_stays_in_range() -> None:
    """A path nearly straight down and one in the direction of -x, with noise of 5 degrees."""
    paths = {"down": paths_of([(5.0, 0.3, np.pi - 0.01, 0.0)]), "seam": paths_of([(5.0, np.pi, 1.5, 0.0)])}
    noise = Noise(azimuth_stdev=5 * DEGREE, zenith_stdev=5 * DEGREE, range_stdev=None)
    rng = np.random.default_rng(11)
    reports = [of_type(simulate_report(paths, noise, rng=rng, timing="none"), "aoa") for _ in range(200)]
    azimuths = np.array([[m["azimuth_deg"] for m in aoa] for aoa in reports])
    zeniths = np.array([[m["zenith_deg"] for m in aoa] for aoa in reports])
    assert (azimuths > -180).all()
    assert (azimuths <= 180).all()
    assert (zeniths >= 0).all()
    assert (zeniths <= 180).all()
    assert (azimuths[:, 1] < -90).any()
    assert (azimuths[:, 1] > 90).any()
    # Reflected at the pole: such reports look the other way.
    over = np.abs(np.degrees(0.3) - azimuths[:, 0]) > 90
    assert 20 < over.sum() < 180


@given(azimuth=st.floats(-20, 20), zenith=st.floats(-20, 20))
def test_folding_keeps_the_direction(azimuth: float, zenith: float) -> None:
    def unit(a: float, z: float) -> NDArray[np.float64]:
        return np.array([np.sin(z) * np.cos(a), np.sin(z) * np.sin(a), np.cos(z)])

    folded_azimuth, folded_zenith = fold_direction(azimuth, zenith)
    assert -np.pi < folded_azimuth <= np.pi
    assert 0 <= folded_zenith <= np.pi
    np.testing.assert_allclose(unit(folded_azimuth, folded_zenith), unit(azimuth, zenith), rtol=0, atol=1e-13)


@pytest.mark.parametrize("azimuth", [np.pi, -np.pi, np.nextafter(np.pi, 4), np.nextafter(-np.pi, -4), 3 * np.pi])
def test_azimuth_at_the_seam_is_never_minus_pi(azimuth: float) -> None:
    folded, _ = fold_direction(azimuth, 1.0)
    assert -np.pi < folded <= np.pi
    assert abs(folded) == pytest.approx(np.pi, abs=1e-14)


def test_drops_are_uniform_in_the_free_part() -> None:
    """A box of 2 x 4 x 1 m of which the half with x < 1 is solid."""
    count = 3000
    points = uniform_drops(lambda x: x[:, 0] > 1.0, (0, 2, -1), (2, 6, 0), count, np.random.default_rng(12))
    assert points.shape == (count, 3)
    low, high = np.array([1.0, 2.0, -1.0]), np.array([2.0, 6.0, 0.0])
    assert (points > low).all()
    assert (points < high).all()
    deviation = (high - low) / np.sqrt(12)
    np.testing.assert_array_less(np.abs(points.mean(axis=0) - (low + high) / 2), 5 * deviation / np.sqrt(count))
    np.testing.assert_allclose(points.std(axis=0) / deviation, 1.0, rtol=0, atol=0.05)
    assert len(uniform_drops(lambda x: x[:, 0] > 1.0, (0, 0, 0), (2, 2, 2), 0, np.random.default_rng(0))) == 0


def test_arguments_that_cannot_be_used(paths_by_station: dict[str, Paths]) -> None:
    rng = np.random.default_rng(13)
    angles_only = Noise(azimuth_stdev=0.01, zenith_stdev=0.01, range_stdev=None)
    with pytest.raises(ValueError, match="range_stdev is None"):
        simulate_report(paths_by_station, angles_only, rng=rng, timing="pt")
    with pytest.raises(ValueError, match="the timing is 'rtt'"):
        simulate_report(paths_by_station, NOISE, rng=rng, timing="rtt")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the rule is 'best'"):
        simulate_report(paths_by_station, NOISE, rng=rng, rule="best")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no path to select"):
        select_path(paths_of(NO_PATHS), "first", rng)
    with pytest.raises(ValueError, match="zenith_stdev is 0"):
        Noise(azimuth_stdev=0.01, zenith_stdev=0.0, range_stdev=None)
    with pytest.raises(ValueError, match="only 0 of 5000 positions"):
        uniform_drops(lambda x: np.zeros(len(x), dtype=bool), (0, 0, 0), (1, 1, 1), 5, rng)
