"""Silicon Labs angles by hand: clockwise azimuths, elevations, deviations, distances."""

import json
import math
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_service.adapters.formats import parse
from rayfix_service.adapters.silabs import parse_silabs, parse_silabs_angle
from rayfix_service.fusion.measurements.report import Angle, Height, Range
from rayfix_service.wire import InvalidReportError, MalformedJsonError

# As aoa_serialize_angle writes it.
PAYLOAD = {
    "azimuth": 30.5,
    "azimuth_stdev": 1.5,
    "elevation": 12.25,
    "elevation_stdev": 2.5,
    "distance": 3.25,
    "distance_stdev": 0.75,
    "sequence": 4711,
}


def message(*angles: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"angles": [{"locator_id": "loc", **angle} for angle in angles], **more}


def without(*keys: str, **values: Any) -> dict[str, Any]:
    """Return the payload with keys left out and others set."""
    return {key: value for key, value in {**PAYLOAD, **values}.items() if key not in keys}


def test_a_payload_becomes_an_angle_and_a_range():
    adapted = parse_silabs(message(PAYLOAD, target_id="tag", stations={"loc": "bs2"}))
    angle, distance = adapted.report.measurements
    assert angle == Angle(
        station_id="bs2",
        azimuth=math.radians(-30.5),
        azimuth_stdev=math.radians(1.5),
        zenith=math.radians(77.75),
        zenith_stdev=math.radians(2.5),
        frame="lcs",
    )
    assert distance == Range(station_id="bs2", path_length=3.25, stdev=0.75)
    assert adapted.report.target_id == "tag"
    assert adapted.sources == (("angles", 0), ("angles", 0))


def test_without_deviation_a_distance_is_not_used():
    assert len(parse_silabs(message(without(distance_stdev=0.0))).report.measurements) == 1
    assert len(parse_silabs(message(without("distance", "distance_stdev"))).report.measurements) == 1


def test_an_azimuth_alone_stays_alone():
    angle, _ = parse_silabs(message(without("elevation", "elevation_stdev"))).report.measurements
    assert isinstance(angle, Angle)
    assert (angle.zenith, angle.zenith_stdev) == (None, None)


def test_deviations_have_a_floor():
    angle, _ = parse_silabs(message(without(azimuth_stdev=0.0, elevation_stdev=0.4))).report.measurements
    assert isinstance(angle, Angle)
    assert (angle.azimuth_stdev, angle.zenith_stdev) == (math.radians(0.5), math.radians(0.5))
    document = message(without(azimuth_stdev=0.0), least_stdev_deg=2.0)
    angle, _ = parse_silabs(document).report.measurements
    assert isinstance(angle, Angle)
    assert angle.azimuth_stdev == math.radians(2.0)


def test_a_known_height_is_passed_on():
    report = parse_silabs(message(PAYLOAD, height={"z_m": 1.2, "stdev_m": 0.1})).report
    assert report.height == Height(z=1.2, stdev=0.1)


def test_angles_may_be_of_another_frame():
    angle, _ = parse_silabs(message(PAYLOAD, frame="scene")).report.measurements
    assert isinstance(angle, Angle)
    assert angle.frame == "scene"


@settings(deadline=None)
@given(st.floats(-360, 360), st.floats(-90, 90))
def test_the_way_back(azimuth: float, elevation: float):
    angle, _ = parse_silabs(message(without(azimuth=azimuth, elevation=elevation))).report.measurements
    assert isinstance(angle, Angle)
    assert angle.zenith is not None
    assert -math.pi < angle.azimuth <= math.pi
    turns = (math.degrees(-angle.azimuth) - azimuth) / 360
    assert turns == pytest.approx(round(turns), abs=1e-9)
    assert 90 - math.degrees(angle.zenith) == pytest.approx(elevation, abs=1e-9)


@pytest.mark.parametrize(
    ("angle", "words"),
    [
        (without("azimuth"), "angles[0].azimuth is missing; give an azimuth in degrees, clockwise"),
        (without("azimuth_stdev"), "angles[0].azimuth_stdev is missing; give a standard deviation in degrees"),
        (without("elevation_stdev"), "angles[0].elevation_stdev is missing; give elevation and elevation_stdev"),
        (without(elevation=90.5), "angles[0].elevation is 90.5; give an elevation in degrees, -90 to 90"),
        (without(azimuth="30"), "angles[0].azimuth is the text '30'; give an azimuth"),
        (without(azimuth=math.nan), "angles[0].azimuth is NaN"),
        (without(distance=-1.0), "angles[0].distance is -1.0; give a distance in metres"),
        (without(sequence=1.5), "angles[0].sequence is 1.5; give the sequence number"),
        (without(locator_id=""), "angles[0].locator_id is ''; give the locator's name"),
    ],
)
def test_refusals_name_the_field_and_the_remedy(angle: dict[str, Any], words: str):
    with pytest.raises(InvalidReportError) as refused:
        parse_silabs(message(angle))
    assert words in str(refused.value)


def test_an_unknown_key_of_the_message_is_refused():
    with pytest.raises(InvalidReportError, match=r"station is an unknown key; did you mean stations\?"):
        parse_silabs(message(PAYLOAD, station={}))


def test_a_payload_of_mqtt():
    angle = parse_silabs_angle(json.dumps({**PAYLOAD, "quality": 7}).encode())
    assert (angle.azimuth, angle.sequence) == (30.5, 4711)
    with pytest.raises(MalformedJsonError):
        parse_silabs_angle(b"not JSON")
    with pytest.raises(InvalidReportError, match="the angle is 5; give a JSON object"):
        parse_silabs_angle(b"5")


@pytest.mark.parametrize("input_format", ["nrppa", "silabs"])
def test_a_report_in_the_format_of_rayfix_is_recognised(input_format: Literal["nrppa", "silabs"]):
    body = b'{"measurements": [{"type": "pt", "station_id": "a", "range_m": 7.0, "stdev_m": 1.0}]}'
    with pytest.raises(InvalidReportError, match="rayfix's own format; leave out the format"):
        parse(body, input_format)
