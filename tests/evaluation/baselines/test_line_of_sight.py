"""Least squares on straight paths: exact without noise, efficient with it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rayfix_evaluation.baselines.line_of_sight import Kind, LineOfSight
from rayfix_service.fusion.measurements.report import Height, Report
from rayfix_tables.table import Table

UE = np.array([1.6, 3.4, 1.1])
BOUNDS = np.array([[0.0, 0.0, 0.0], [4.0, 5.0, 3.0]])


def rival(room: Table, *kinds: Kind) -> LineOfSight:
    return LineOfSight(site=room.site, bounds=BOUNDS, kinds=kinds)


@pytest.mark.parametrize(
    ("kind", "fitted", "names"),
    [
        ("aoa", "angles", "ab"),
        ("aoa", "angles", "abcd"),
        ("pt", "ranges", "abcd"),
        ("tdoa", "differences", "abcd"),
        ("toa", "differences", "dcab"),
    ],
)
def test_without_noise_the_position_is_exact(room: Table, measure: Any, kind: str, fitted: Kind, names: str) -> None:
    found = rival(room, fitted).locate(Report(measurements=measure(kind, names)))
    assert found is not None
    np.testing.assert_allclose(found, UE, rtol=0, atol=1e-3)


@pytest.mark.parametrize("corner", [(0.2, 0.2, 0.1), (3.8, 4.8, 2.9), (0.1, 4.9, 0.2)])
def test_positions_near_walls_are_found_too(room: Table, measure: Any, corner: tuple[float, float, float]) -> None:
    point = np.array(corner)
    for kind, fitted in (("aoa", "angles"), ("pt", "ranges"), ("toa", "differences")):
        found = rival(room, fitted).locate(Report(measurements=measure(kind, "abcd", point)))  # type: ignore[arg-type]
        assert found is not None
        np.testing.assert_allclose(found, point, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("kind", "fitted", "names"),
    [("aoa", "angles", "a"), ("pt", "ranges", "ab"), ("toa", "differences", "abc"), ("aoa", "ranges", "abcd")],
)
def test_too_little_gives_no_position(room: Table, measure: Any, kind: str, fitted: Kind, names: str) -> None:
    assert rival(room, fitted).locate(Report(measurements=measure(kind, names))) is None


def test_a_known_height_is_an_equation(room: Table, measure: Any) -> None:
    ranges = Report(measurements=measure("pt", "ab"), height=Height(z=1.1, stdev=0.01))
    found = rival(room, "ranges").locate(ranges)
    assert found is not None
    # Two ranges and a height leave one mirrored position, outside of the room.
    np.testing.assert_allclose(found, UE, rtol=0, atol=1e-3)


def test_kinds_join(room: Table, measure: Any) -> None:
    """One station's angle and range, neither of which determines a position."""
    report = Report(measurements=measure("aoa", "a") + measure("pt", "a"))
    assert rival(room, "angles").locate(report) is None
    found = rival(room, "angles", "ranges").locate(report)
    assert found is not None
    np.testing.assert_allclose(found, UE, rtol=0, atol=1e-3)


def test_time_differences_weigh_as_times_on_an_unknown_clock(room: Table, measure: Any) -> None:
    """Differences to a common reference are correlated: which station is the reference must not matter."""
    rng = np.random.default_rng(1)
    noise = dict(zip("abcd", rng.normal(0.0, 0.1, 4), strict=True))
    found = []
    for names in ("abcd", "cadb"):
        arrivals = {m.station_id: m.path_length + noise[m.station_id] for m in measure("pt", names)}
        differences = [
            type(m)(
                station_id=m.station_id,
                reference_station_id=m.reference_station_id,
                length_difference=arrivals[m.station_id] - arrivals[m.reference_station_id],
                stdev=m.stdev,
            )
            for m in measure("tdoa", names)
        ]
        found.append(rival(room, "differences").locate(Report(measurements=tuple(differences))))
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-4)
    assert np.linalg.norm(found[0] - UE) > 0.01


def test_noise_scatters_fixes_as_the_information_says(room: Table, measure: Any) -> None:
    """Angles of 10 and 20 mrad: the covariance of 200 fixes is the inverse of the Fisher information."""
    rng = np.random.default_rng(2)
    exact = measure("aoa", "abcd")
    locator = rival(room, "angles")
    fixes = []
    for _ in range(200):
        noisy = tuple(
            type(m)(
                station_id=m.station_id,
                azimuth=m.azimuth + rng.normal(0.0, m.azimuth_stdev),
                zenith=m.zenith + rng.normal(0.0, m.zenith_stdev),
                azimuth_stdev=m.azimuth_stdev,
                zenith_stdev=m.zenith_stdev,
            )
            for m in exact
        )
        fixes.append(locator.locate(Report(measurements=noisy)))
    information = np.zeros((3, 3))
    for station in room.site.stations:
        x, y, z = UE - station.position
        flat = np.hypot(x, y)
        azimuth = np.array([-y, x, 0.0]) / flat**2
        zenith = np.array([x * z / flat, y * z / flat, -flat]) / (flat**2 + z**2)
        information += np.outer(azimuth, azimuth) / 0.01**2 + np.outer(zenith, zenith) / 0.02**2
    # The squared Mahalanobis distance is chi-square of 3 degrees: mean 3, standard error sqrt(6 / 200) = 0.17.
    apart = np.array(fixes) - UE
    assert np.mean(np.einsum("ni,ij,nj->n", apart, information, apart)) == pytest.approx(3.0, abs=0.6)


def test_the_name_says_what_is_fitted(room: Table) -> None:
    assert rival(room, "angles").name == "line of sight, angles"
    assert rival(room, "angles", "ranges").name == "line of sight, angles and ranges"
    robust = replace(rival(room, "angles", "ranges"), robust=True)
    assert robust.name == "robust line of sight, angles and ranges"


def test_the_robust_variant_leaves_a_reflected_path_aside(room: Table, measure: Any) -> None:
    """One station of four reports the image of the transmitter in the ceiling: squares are dragged there."""
    image = UE * [1.0, 1.0, -1.0] + [0.0, 0.0, 6.0]
    report = Report(
        measurements=measure("aoa", "abc")
        + measure("pt", "abc")
        + measure("aoa", "d", image)
        + measure("pt", "d", image)
    )
    squares = rival(room, "angles", "ranges")
    plain, robust = squares.locate(report), replace(squares, robust=True).locate(report)
    assert plain is not None
    assert robust is not None
    assert np.linalg.norm(plain - UE) > 0.3
    assert np.linalg.norm(robust - UE) < 0.01


def test_the_robust_variant_is_exact_and_minimises_cauchys_loss(room: Table, measure: Any) -> None:
    """Without noise the truth; with it, no point around has a smaller loss, computed here from the definition."""
    robust = replace(rival(room, "angles", "ranges", "differences"), robust=True)
    for kinds in (("aoa",), ("aoa", "pt"), ("aoa", "toa"), ("aoa", "tdoa")):
        exact = robust.locate(Report(measurements=sum((measure(kind) for kind in kinds), ())))
        assert exact is not None
        np.testing.assert_allclose(exact, UE, rtol=0, atol=1e-3)
    rng = np.random.default_rng(4)
    lengths = {m.station_id: m.path_length + rng.normal(0.0, m.stdev) for m in measure("pt")}
    noisy = tuple(
        type(m)(station_id=m.station_id, path_length=lengths[m.station_id], stdev=m.stdev) for m in measure("pt")
    )
    found = robust.locate(Report(measurements=measure("aoa") + noisy))
    assert found is not None

    def loss(point: NDArray[np.float64]) -> float:
        total = 0.0
        for station in room.site.stations:
            x, y, z = point - station.position
            x0, y0, z0 = UE - station.position
            turned = np.arctan2(y, x) - np.arctan2(y0, x0)
            residuals = [
                (np.mod(turned + np.pi, 2 * np.pi) - np.pi) / 0.01,
                (np.arctan2(np.hypot(x, y), z) - np.arctan2(np.hypot(x0, y0), z0)) / 0.02,
                (np.sqrt(x * x + y * y + z * z) - lengths[station.id]) / 0.3,
            ]
            total += float(np.log1p(np.square(residuals)).sum())
        return total

    around = found + rng.normal(0.0, 0.01, (200, 3))
    assert loss(found) <= min(loss(point) for point in around)
    assert loss(found) < loss(UE)
