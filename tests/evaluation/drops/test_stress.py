"""What is spoilt changes as it should, and the rest stays."""

from typing import Any

import numpy as np
import pytest
import trimesh

from rayfix_evaluation.drops.stress import (
    move_scene,
    with_late_time,
    with_random_angle,
    with_scaled_stdevs,
    with_turned_stations,
)
from rayfix_tables.geometry.angles import direction

REPORT: dict[str, Any] = {
    "target_id": "ue",
    "measurements": [
        {
            "type": "aoa",
            "station_id": name,
            "azimuth_deg": azimuth,
            "zenith_deg": 100.0,
            "azimuth_stdev_deg": 1.0,
            "zenith_stdev_deg": 2.0,
        }
        for name, azimuth in (("a", 10.0), ("b", -179.9))
    ]
    + [
        {"type": "pt", "station_id": "a", "range_m": 5.0, "stdev_m": 0.5},
        {"type": "toa", "station_id": "b", "range_m": 105.0, "stdev_m": 0.5},
        {
            "type": "tdoa",
            "station_id": "b",
            "reference_station_id": "a",
            "range_difference_m": 1.0,
            "stdev_m": 0.7,
        },
    ],
}


def changes(report: dict[str, Any]) -> set[tuple[int, str]]:
    """Measurements and keys in which a report differs from the sound one."""
    return {
        (n, key)
        for n, (before, after) in enumerate(zip(REPORT["measurements"], report["measurements"], strict=True))
        for key in before
        if before[key] != after[key]
    }


def test_random_angles_come_from_all_around() -> None:
    rng = np.random.default_rng(1)
    spoilt = [with_random_angle(REPORT, "b", rng) for _ in range(2000)]
    assert changes(spoilt[0]) == {(1, "azimuth_deg"), (1, "zenith_deg")}
    angles = np.array([[r["measurements"][1][k] for k in ("azimuth_deg", "zenith_deg")] for r in spoilt])
    mean = direction(*np.deg2rad(angles).T).mean(axis=0)
    assert np.linalg.norm(mean) < 4.0 / np.sqrt(2000)


def test_a_late_clock_shifts_all_that_it_went_into() -> None:
    late = with_late_time(REPORT, "b", 10.0)
    assert changes(late) == {(3, "range_m"), (4, "range_difference_m")}
    assert late["measurements"][3]["range_m"] == 115.0
    assert late["measurements"][4]["range_difference_m"] == 11.0
    assert with_late_time(REPORT, "a", 10.0)["measurements"][4]["range_difference_m"] == -9.0


def test_all_deviations_are_scaled() -> None:
    scaled = with_scaled_stdevs(REPORT, 2.0)["measurements"]
    assert (scaled[0]["azimuth_stdev_deg"], scaled[0]["zenith_stdev_deg"]) == (2.0, 4.0)
    assert [m["stdev_m"] for m in scaled[2:]] == [1.0, 1.0, 1.4]


def test_turned_stations_see_at_most_the_angle_off() -> None:
    rng = np.random.default_rng(2)
    off = []
    for _ in range(300):
        turned = with_turned_stations(REPORT, 0.01, rng)
        assert changes(turned) <= {(n, key) for n in (0, 1) for key in ("azimuth_deg", "zenith_deg")}
        for before, after in zip(REPORT["measurements"][:2], turned["measurements"], strict=False):
            one, other = (direction(np.deg2rad(m["azimuth_deg"]), np.deg2rad(m["zenith_deg"])) for m in (before, after))
            off.append(np.linalg.norm(np.cross(one, other)))
    assert max(off) <= np.sin(0.01) + 1e-12
    # Axes all around: the mean of sin^2 between axis and direction is 2 / 3.
    assert np.mean(np.square(off)) == pytest.approx(2.0 / 3.0 * 0.01**2, rel=0.1)


def test_objects_and_walls_move_by_what_was_asked() -> None:
    """A room with a cabinet, a shelf beside it that touches it, and a table alone."""
    boxes = [
        [(0, 0, 0), (4, 5, 3)],
        [(0.5, 1.0, 0.0), (1.3, 2.2, 1.8)],
        [(1.31, 1.0, 0.0), (1.5, 1.4, 1.0)],
        [(2.4, 2.8, 0.9), (3.4, 4.1, 1.1)],
    ]
    meshes = [trimesh.creation.box(bounds=bounds) for bounds in boxes]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + 8 * n for n, mesh in enumerate(meshes)])
    stations = np.array([[0.1, 0.1, 2.9], [3.9, 4.9, 2.9]])
    moved = move_scene(vertices, faces, stations, objects=0.05, walls=0.02, rng=np.random.default_rng(3))
    shift = (moved - vertices).reshape(4, 8, 3)
    # A wall's vertices move along each axis by the walls' 2 cm.
    np.testing.assert_allclose(np.abs(shift[0]), 0.02, rtol=0, atol=1e-12)
    for axis in range(3):
        for side in (0.0, boxes[0][1][axis]):
            on_side = vertices[:8, axis] == side
            assert len(set(np.round(shift[0, on_side, axis], 9))) == 1
    # Objects move as a whole, on the floor; those that touch move together.
    for n in (1, 2, 3):
        np.testing.assert_allclose(shift[n], shift[n, :1].repeat(8, axis=0), rtol=0, atol=1e-12)
        assert shift[n, 0, 2] == pytest.approx(0.0, abs=1e-12)
        assert np.linalg.norm(shift[n, 0]) == pytest.approx(0.05, abs=1e-12)
    np.testing.assert_allclose(shift[1, 0], shift[2, 0], rtol=0, atol=1e-12)
    assert np.linalg.norm(shift[1, 0] - shift[3, 0]) > 1e-3
    assert np.all(
        move_scene(vertices, faces, stations, objects=0.0, walls=0.0, rng=np.random.default_rng(3)) == vertices
    )
