"""Angles, directions and rotations against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rayfix_tables.geometry.angles import angles_of, direction, local_to_scene, tangent, wrap, wrap_one

ROUNDING = 1e-15  # of numbers of size 1
angles = st.floats(-1e4, 1e4)
azimuths = st.floats(-np.pi, np.pi, exclude_min=True)
zeniths = st.floats(0.0, np.pi)


@settings(deadline=None)
@given(angles)
def test_wrap_stays_in_its_interval_and_turns_by_whole_turns(angle: float) -> None:
    wrapped = float(wrap(angle))
    assert -np.pi < wrapped <= np.pi
    # math.remainder is exact, so that what is left is the rounding of pi and of the angle itself.
    assert abs(math.remainder(angle - wrapped, 2.0 * np.pi)) <= 4.0 * np.spacing(max(abs(angle), np.pi))


@settings(deadline=None)
@given(azimuths)
def test_wrap_leaves_what_is_wrapped(azimuth: float) -> None:
    assert float(wrap(azimuth)) == azimuth


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [
        (np.pi, np.pi),
        (-np.pi, np.pi),
        (3.0 * np.pi, np.pi),
        (np.nextafter(np.pi, 4.0), np.nextafter(-np.pi, 0.0)),
        (np.nextafter(-np.pi, 0.0), np.nextafter(-np.pi, 0.0)),
        (0.0, 0.0),
        (2.0 * np.pi, 0.0),
        (1.5 * np.pi, -0.5 * np.pi),
        (-1.5 * np.pi, 0.5 * np.pi),
    ],
)
def test_wrap_at_the_seam(angle: float, wrapped: float) -> None:
    assert float(wrap(angle)) == wrapped
    assert wrap_one(angle) == wrapped


@settings(deadline=None)
@given(st.floats(-3.0 * np.pi, 3.0 * np.pi))
def test_one_angle_is_wrapped_as_arrays_are(angle: float) -> None:
    # Whole turns come off exactly, so that only the seam's two ends might be told apart.
    assert wrap_one(angle) == float(wrap(angle))


def test_wrap_next_to_all_half_turns() -> None:
    """The quotient by a turn is rounded to a half from either side."""
    for turns in np.arange(-40, 41) / 2.0:
        angle = turns * 2.0 * np.pi
        for _ in range(4):
            wrapped = float(wrap(angle))
            assert -np.pi < wrapped <= np.pi
            assert abs(math.remainder(angle - wrapped, 2.0 * np.pi)) <= 4.0 * np.spacing(max(abs(angle), np.pi))
            angle = np.nextafter(angle, np.inf)


@settings(deadline=None)
@given(azimuths, st.floats(-0.9, 0.9), st.integers(-3, 3))
def test_a_difference_across_the_seam_is_the_small_one(azimuth: float, step: float, turns: int) -> None:
    difference = float(wrap(azimuth + step + turns * 2.0 * np.pi - azimuth))
    assert abs(difference - step) < 1e-14


def test_wrap_keeps_the_shape() -> None:
    assert wrap(np.zeros((2, 3))).shape == (2, 3)
    assert wrap(0.0).shape == ()


@pytest.mark.parametrize(
    ("azimuth_deg", "zenith_deg", "expected"),
    [
        (0, 90, (1, 0, 0)),
        (90, 90, (0, 1, 0)),
        (180, 90, (-1, 0, 0)),
        (-90, 90, (0, -1, 0)),
        (17, 0, (0, 0, 1)),
        (17, 180, (0, 0, -1)),
        (30, 60, (0.75, np.sqrt(3) / 4, 0.5)),
        (-120, 135, (-np.sqrt(2) / 4, -np.sqrt(6) / 4, -np.sqrt(2) / 2)),
    ],
)
def test_direction(azimuth_deg: float, zenith_deg: float, expected: tuple[float, float, float]) -> None:
    """Azimuth from +x towards +y, zenith from +z."""
    found = direction(np.deg2rad(azimuth_deg), np.deg2rad(zenith_deg))
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)


def test_direction_broadcasts() -> None:
    assert direction(np.zeros((4, 1)), np.zeros(5)).shape == (4, 5, 3)


@settings(deadline=None)
@given(azimuths, st.floats(1e-3, np.pi - 1e-3), st.floats(1e-3, 1e3))
def test_angles_of_inverts_direction(azimuth: float, zenith: float, length: float) -> None:
    back_azimuth, back_zenith = angles_of(length * direction(azimuth, zenith))
    assert -np.pi < float(back_azimuth) <= np.pi
    assert abs(float(wrap(back_azimuth - azimuth))) < 1e-15 * 4 / math.sin(zenith)
    assert abs(float(back_zenith) - zenith) < 1e-15


def test_angles_of_vectors_on_the_seam_have_azimuth_pi() -> None:
    """``arctan2`` of a negative zero is -pi, which is no azimuth."""
    azimuth, zenith = angles_of([[-1.0, 0.0, 0.0], [-1.0, -0.0, 0.0]])
    np.testing.assert_allclose(azimuth, [np.pi, np.pi], rtol=0, atol=1e-15)
    assert azimuth.max() <= np.pi
    np.testing.assert_allclose(zenith, [np.pi / 2, np.pi / 2], rtol=0, atol=1e-15)


@settings(deadline=None)
@given(azimuths, zeniths, azimuths, zeniths)
def test_tangent_is_odd_in_the_deviation(azimuth: float, zenith: float, centre: float, centre_zenith: float) -> None:
    horizontal, vertical = tangent(azimuth, zenith, centre, centre_zenith)
    assert vertical == zenith - centre_zenith
    assert abs(horizontal) <= np.sin(centre_zenith) * np.pi
    # Undone: the azimuth comes back wherever the chart is not flat.
    if np.sin(centre_zenith) > 1e-3:
        back = wrap(centre + horizontal / np.sin(centre_zenith) - azimuth)
        assert abs(float(back)) < 1e-11


@settings(deadline=None)
@given(azimuths, st.floats(0.2, np.pi - 0.2), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_tangent_coordinates_are_arcs_near_the_centre(
    azimuth: float, zenith: float, horizontal: float, vertical: float
) -> None:
    """The distance in the chart is the angle between the directions, up to second order."""
    small = 1e-4  # rad
    other_azimuth, other_zenith = azimuth + small * horizontal / np.sin(zenith), zenith + small * vertical
    there = tangent(wrap(other_azimuth), other_zenith, azimuth, zenith)
    np.testing.assert_allclose(there, [small * horizontal, small * vertical], rtol=0, atol=1e-14)
    chord = np.linalg.norm(direction(other_azimuth, other_zenith) - direction(azimuth, zenith))
    # The next order is cot(zenith) horizontal^2 vertical / 2 and the like.
    assert abs(chord - np.linalg.norm(there)) < 10.0 * small**2 * np.hypot(horizontal, vertical) + 1e-15


def rotation_deg(bearing: float, downtilt: float, slant: float) -> NDArray[np.float64]:
    """Rotation of angles in degrees."""
    a, b, c = np.deg2rad((bearing, downtilt, slant))
    return local_to_scene((float(a), float(b), float(c)))


def test_bearing_downtilt_and_slant_by_hand() -> None:
    """A panel that looks along +y and 30 deg down, then rolled by a quarter turn.

    ::

        z            bearing 90: local x is scene y, local y is scene -x
        | /y         downtilt 30: local x leans to (0, cos 30, -sin 30)
        |/___x       slant 90: local y turns to where local z was, local z to where -y was
    """
    half, root = 0.5, np.sqrt(3) / 2
    np.testing.assert_allclose(rotation_deg(90, 0, 0), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(
        rotation_deg(90, 30, 0), [[0, -1, 0], [root, 0, half], [-half, 0, root]], rtol=0, atol=ROUNDING
    )
    np.testing.assert_allclose(
        rotation_deg(90, 30, 90), [[0, 0, 1], [root, half, 0], [-half, root, 0]], rtol=0, atol=ROUNDING
    )


def test_rotation_of_the_standard() -> None:
    """3GPP TR 38.901, equation (7.1-4), written out entry by entry."""
    a, b, c = 0.4, -0.3, 1.1
    (ca, cb, cc), (sa, sb, sc) = np.cos((a, b, c)), np.sin((a, b, c))
    expected = [
        [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
        [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
        [-sb, cb * sc, cb * cc],
    ]
    np.testing.assert_allclose(local_to_scene((a, b, c)), expected, rtol=0, atol=ROUNDING)


@settings(deadline=None)
@given(st.tuples(azimuths, azimuths, azimuths))
def test_local_to_scene_is_a_rotation(orientation: tuple[float, float, float]) -> None:
    matrix = local_to_scene(orientation)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=ROUNDING)
    assert abs(np.linalg.det(matrix) - 1.0) < ROUNDING * 2
