"""Mounted arrays: the axes of the board in the scene, whatever the local frame is called."""

from itertools import product

import numpy as np
import pytest

from rayfix_tables.geometry.angles import local_to_scene
from rayfix_tables.geometry.mounting import FRAMES, Boresight, board_to_scene, boresight_of, orientation_of
from rayfix_tables.site import Mounting, Station

DEG = np.pi / 180


def mounted(mounting: Mounting, azimuth: float, downtilt: float, roll: float) -> Station:
    """Mount an array by angles in degrees."""
    turned = orientation_of(mounting, Boresight(azimuth * DEG, downtilt * DEG), roll * DEG)
    return Station(id="s", position=(0.0, 0.0, 0.0), orientation=turned, mounting=mounting)


@pytest.mark.parametrize("mounting", FRAMES)
def test_the_board_stands_as_it_is_mounted(mounting: Mounting) -> None:
    """On a wall that looks to +y, tilted down by 30 deg: the upper edge leans forward, the left edge points to -x."""
    board = board_to_scene(mounted(mounting, 90, 30, 0))
    cosine, sine = np.cos(30 * DEG), np.sin(30 * DEG)
    expected = np.column_stack([(0, cosine, -sine), (-1, 0, 0), (0, sine, cosine)])
    np.testing.assert_allclose(board, expected, atol=1e-15)


@pytest.mark.parametrize("mounting", FRAMES)
def test_a_roll_lowers_the_right_edge(mounting: Mounting) -> None:
    """Clockwise for who looks along the boresight: the upper edge goes to the right, which for +x is -y."""
    board = board_to_scene(mounted(mounting, 0, 0, 90))
    np.testing.assert_allclose(board, np.column_stack([(1, 0, 0), (0, 0, 1), (0, -1, 0)]), atol=1e-15)


def test_silicon_labs_arrays_look_along_z() -> None:
    station = mounted("silabs", 0, 30, 0)
    assert np.rad2deg(station.orientation) == pytest.approx((90, 0, 120), abs=1e-12)
    turn = local_to_scene(station.orientation)
    np.testing.assert_allclose(turn[:, 2], (np.cos(30 * DEG), 0, -0.5), atol=1e-15)
    # Under a ceiling, as docs/formats.md has it.
    assert np.rad2deg(mounted("silabs", 0, 90, 0).orientation) == pytest.approx((90, 0, 180), abs=1e-6)


@pytest.mark.parametrize("mounting", FRAMES)
def test_angles_and_rotation_are_the_same_mount(mounting: Mounting) -> None:
    """Also where the array looks straight up or down, and where its local x axis does."""
    for azimuth, downtilt, roll in product((-170, -90, 0, 40, 180), (-90, -45, 0, 20, 90), (-90, 0, 90, 135)):
        station = mounted(mounting, azimuth, downtilt, roll)
        board = local_to_scene((azimuth * DEG, downtilt * DEG, roll * DEG))
        np.testing.assert_allclose(board_to_scene(station), board, atol=1e-12)
        looks = boresight_of(station)
        assert looks.downtilt == pytest.approx(downtilt * DEG, abs=1e-7)
        if abs(downtilt) < 90:
            assert np.exp(1j * looks.azimuth) == pytest.approx(np.exp(1j * azimuth * DEG), abs=1e-12)
