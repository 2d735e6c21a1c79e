"""Integers of TS 38.133 against intervals written down by hand in exact fractions."""

import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_service.adapters.report_mapping import (
    ANGLE_STEP,
    TC_METRES,
    TC_NANOSECONDS,
    angle_interval,
    largest_time_value,
    time_interval,
)

TC = Fraction(1, 480_000 * 4096)  # s
C = 299_792_458  # m/s

# ULRTOAMeas and GNBRxTxTimeDiffMeas of TS 38.455 V18.6.0, 9.3.5.
ASN1_LARGEST = {
    0: 1970049,
    1: 985025,
    2: 492513,
    3: 246257,
    4: 123129,
    5: 61565,
    -1: 3940097,
    -2: 7880193,
    -3: 15760385,
    -4: 31520769,
    -5: 63041537,
    -6: 126083073,
}


def reported(time: Fraction, k: int) -> int:
    """Encode a time, s, as TS 38.133 says: the number of the interval that holds it."""
    in_tc = time / TC
    if in_tc < -985024:
        return 0
    if in_tc >= 985024:
        return ASN1_LARGEST[k]
    return math.floor((in_tc + 985024) / Fraction(2) ** k) + 1


def test_the_units():
    assert pytest.approx(float(TC * 10**9), rel=1e-15) == TC_NANOSECONDS
    assert pytest.approx(float(TC * C), rel=1e-15) == TC_METRES
    assert math.degrees(ANGLE_STEP) == pytest.approx(0.1, rel=1e-15)


@pytest.mark.parametrize(("k", "largest"), ASN1_LARGEST.items())
def test_the_intervals_fill_the_range_of_the_asn1(k: int, largest: int):
    assert largest_time_value(k) == largest
    first, last = time_interval(1, k), time_interval(largest - 1, k)
    assert first is not None
    assert last is not None
    assert first.middle - first.width / 2 == pytest.approx(-985024 * TC_METRES, rel=1e-12)
    assert last.middle + last.width / 2 == pytest.approx(985024 * TC_METRES, rel=1e-12)
    assert time_interval(0, k) is None
    assert time_interval(largest, k) is None


@pytest.mark.parametrize(
    ("value", "k", "middle_tc"),
    [(1, 0, -985023.5), (985025, 0, 0.5), (492513, 1, 1.0), (30783, 5, 16.0), (63041536, -6, -1 / 128)],
)
def test_values_by_hand(value: int, k: int, middle_tc: float):
    interval = time_interval(value, k)
    assert interval is not None
    # 1e-9 m is far below the finest step, 2.4 mm.
    assert interval.middle == pytest.approx(float(TC * C) * middle_tc, abs=1e-9)
    assert interval.width == pytest.approx(float(TC * C) * 2.0**k, rel=1e-12)
    assert interval.variance == pytest.approx((float(TC * C) * 2.0**k) ** 2 / 12, rel=1e-12)


@settings(deadline=None)
@given(st.integers(-6, 5), st.fractions(-985024, 985024 - Fraction(1, 10**6)))
def test_a_time_is_within_half_a_step_of_what_its_value_decodes_to(k: int, in_tc: Fraction):
    interval = time_interval(reported(in_tc * TC, k), k)
    assert interval is not None
    assert abs(interval.middle - float(in_tc * TC * C)) <= 0.5 * interval.width * (1 + 1e-6)


@settings(deadline=None)
@given(st.integers(-6, 5), st.data())
def test_the_middle_of_an_interval_is_reported_as_its_value(k: int, data: st.DataObject):
    value = data.draw(st.integers(1, ASN1_LARGEST[k] - 1))
    interval = time_interval(value, k)
    assert interval is not None
    assert reported(Fraction(interval.middle) / C, k) == value


@settings(deadline=None)
@given(st.integers(0, 3599))
def test_angles_are_in_the_middle_of_their_tenth_of_a_degree(value: int):
    interval = angle_interval(value)
    assert math.degrees(interval.middle) == pytest.approx(value / 10 + 0.05, abs=1e-9)
    assert math.floor(math.degrees(interval.middle) * 10) == value
    shifted = angle_interval(value, zero=-math.pi)
    assert math.degrees(shifted.middle) == pytest.approx(value / 10 + 0.05 - 180, abs=1e-9)
    assert interval.variance == pytest.approx(math.radians(0.1) ** 2 / 12, rel=1e-12)
