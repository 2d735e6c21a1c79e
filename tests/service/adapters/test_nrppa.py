"""NRPPa measurements by hand: angles, arrivals, round trips, qualities, and every refusal."""

import copy
import json
import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rayfix_service.adapters.nrppa import parse_nrppa
from rayfix_service.fusion.measurements.report import Angle, Height, MeasuredPath, Range, TimeOfArrival
from rayfix_service.wire import InvalidReportError, MalformedJsonError

TC_M = 299_792_458 / (480_000 * 4096)  # m
RESPONSE = "TRP-MeasurementResponseList"


def item(value: dict[str, Any], quality: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """One measurement; the time stamp is as mandatory as it is of no use."""
    stamp = {"systemFrameNumber": 5, "slotIndex": {"sCS-30": 3}}
    measured = {"measuredResultsValue": value, "timeStamp": stamp, **more}
    return measured if quality is None else {**measured, "measurementQuality": quality}


def message(*items: dict[str, Any], trp: int = 7, **more: Any) -> dict[str, Any]:
    """Measurements of one TRP."""
    return {RESPONSE: [{"tRP-ID": trp, "measurementResult": list(items)}], **more}


def aoa(azimuth: int, zenith: int | None = None, translation: tuple[int, int, int] | None = None) -> dict[str, Any]:
    """UL-AoA."""
    angle: dict[str, Any] = {"azimuthAoA": azimuth}
    if zenith is not None:
        angle["zenithAoA"] = zenith
    if translation is not None:
        angle["lCS-to-GCS-Translation"] = dict(zip(("alpha", "beta", "gamma"), translation, strict=True))
    return angle


def angle_quality(azimuth: int, zenith: int | None = None) -> dict[str, Any]:
    """Angle quality in tenths of a degree."""
    quality: dict[str, Any] = {"azimuthQuality": azimuth, "resolution": "deg0dot1"}
    if zenith is not None:
        quality["zenithQuality"] = zenith
    return {"angleMeasQuality": quality}


def timing_quality(value: int, resolution: str) -> dict[str, Any]:
    """Write a timing quality."""
    return {"timingMeasQuality": {"measurementQuality": value, "resolution": resolution}}


def only(document: dict[str, Any]) -> Any:
    """Return the only measurement of a message."""
    (measurement,) = parse_nrppa(document).report.measurements
    return measurement


def degrees(*angles: float) -> list[float]:
    return [math.degrees(angle) for angle in angles]


def test_an_angle_counts_from_north_counter_clockwise():
    measured = only(message(item({"uL-AngleOfArrival": aoa(412, 1035)}, angle_quality(20, 10))))
    assert isinstance(measured, Angle)
    assert (measured.station_id, measured.frame) == ("7", "north")
    assert measured.zenith is not None
    assert degrees(measured.azimuth, measured.zenith) == pytest.approx([41.25, 103.55], abs=1e-9)
    # 2 deg and 1 deg, and a uniform tenth of a degree
    expected = [math.sqrt(2.0**2 + 0.01 / 12), math.sqrt(1.0**2 + 0.01 / 12)]
    assert degrees(measured.azimuth_stdev, measured.zenith_stdev or 0) == pytest.approx(expected, rel=1e-12)


def test_azimuths_beyond_half_a_turn_are_wrapped():
    assert degrees(only(message(item({"uL-AngleOfArrival": aoa(3599, 900)}))).azimuth) == pytest.approx([-0.05])


def test_value_zero_may_mean_minus_180_degrees():
    document = message(item({"uL-AngleOfArrival": aoa(412, 1035)}), azimuth_zero_deg=-180)
    assert degrees(only(document).azimuth) == pytest.approx([41.25 - 180], abs=1e-9)


def test_an_azimuth_alone_stays_alone():
    measured = only(message(item({"uL-AngleOfArrival": aoa(412)}, angle_quality(20))))
    assert (measured.zenith, measured.zenith_stdev) == (None, None)


def test_without_quality_the_defaults_of_the_message_hold():
    document = message(item({"uL-AngleOfArrival": aoa(412, 1035)}), angle_stdev_deg=3.0)
    measured = only(document)
    expected = math.sqrt(9.0 + 0.01 / 12)
    assert degrees(measured.azimuth_stdev, measured.zenith_stdev) == pytest.approx([expected] * 2, rel=1e-12)
    document = message(item({"uL-AngleOfArrival": aoa(412, 1035)}, angle_quality(20)), angle_stdev_deg=3.0)
    measured = only(document)
    assert degrees(measured.azimuth_stdev) == pytest.approx([math.sqrt(4.0 + 0.01 / 12)], rel=1e-12)
    assert degrees(measured.zenith_stdev) == pytest.approx([expected], rel=1e-12)


def test_quality_zero_is_half_a_step():
    measured = only(message(item({"uL-AngleOfArrival": aoa(412, 1035)}, angle_quality(0, 0))))
    assert degrees(measured.azimuth_stdev) == pytest.approx([math.sqrt(0.05**2 + 0.01 / 12)], rel=1e-12)


def test_a_bearing_turns_azimuths_alone():
    with_zenith = only(message(item({"uL-AngleOfArrival": aoa(3550, 1035, (450, 0, 0))}, angle_quality(20, 10))))
    assert degrees(with_zenith.azimuth, with_zenith.zenith) == pytest.approx([40.05, 103.55], abs=1e-9)
    expected = [math.sqrt(2.0**2 + 0.01 / 12), math.sqrt(1.0**2 + 0.01 / 12)]
    assert degrees(with_zenith.azimuth_stdev, with_zenith.zenith_stdev) == pytest.approx(expected, rel=1e-9)
    alone = only(message(item({"uL-AngleOfArrival": aoa(3550, None, (450, 0, 0))})))
    assert degrees(alone.azimuth) == pytest.approx([40.05], abs=1e-9)


@pytest.mark.parametrize("translation", [(450, 100, 0), (3000, 150, 50), (10, 3500, 1800)])
def test_a_translation_is_the_rotation_of_tr_38_901(translation: tuple[int, int, int]):
    """Against SciPy's Euler angles, and the deviations against turned samples."""
    document = message(item({"uL-AngleOfArrival": aoa(200, 1000, translation)}, angle_quality(10, 5)))
    measured = only(document)
    rotation = Rotation.from_euler("ZYX", [angle / 10 for angle in translation], degrees=True)
    noise = np.random.default_rng(3).normal(size=(2, 200_000)) * [[1.0], [0.5]]
    azimuth, zenith = np.deg2rad(np.array([[20.05], [100.05]]) + np.hstack([np.zeros((2, 1)), noise]))
    vectors = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)
    x, y, z = rotation.apply(vectors).T
    turned_azimuth, turned_zenith = np.arctan2(y, x), np.arccos(z)
    assert measured.azimuth == pytest.approx(turned_azimuth[0], abs=1e-12)
    assert measured.zenith == pytest.approx(turned_zenith[0], abs=1e-12)
    # 200,000 samples: 0.2 % of a deviation; curvature at 1 deg is below a percent.
    about = np.angle(np.exp(1j * (turned_azimuth[1:] - turned_azimuth[0])))
    assert measured.azimuth_stdev == pytest.approx(about.std(), rel=0.015)
    assert measured.zenith_stdev == pytest.approx(turned_zenith[1:].std(), rel=0.015)
    assert measured.correlation == pytest.approx(np.corrcoef(about, turned_zenith[1:])[0, 1], abs=0.01)


def test_several_angles_of_one_trp_are_several_measurements():
    choices = [{"uL-AoA": aoa(100, 900)}, {"ul-ZoA": {"zenithAoA": 910}}, {"uL-AoA": aoa(200, 920)}]
    adapted = parse_nrppa(message(item({"MultipleULAoA": {"multipleULAoA": choices}}), stations={"7": "bs3"}))
    first, second = adapted.report.measurements
    assert isinstance(first, Angle)
    assert isinstance(second, Angle)
    assert (first.station_id, second.station_id) == ("bs3", "bs3")
    assert degrees(first.azimuth, second.azimuth) == pytest.approx([10.05, 20.05], abs=1e-9)
    place = (RESPONSE, 0, "measurementResult", 0, "measuredResultsValue", "MultipleULAoA", "multipleULAoA")
    assert adapted.sources == ((*place, 0, "uL-AoA"), (*place, 2, "uL-AoA"))
    (skipped,) = adapted.skipped
    assert skipped.path == (*place, 1, "ul-ZoA")
    assert "without an azimuth" in skipped.reason


def test_paths_of_one_quantised_angle_count_once():
    choices = [{"uL-AoA": aoa(100, 900)}, {"uL-AoA": aoa(200, 920)}, {"uL-AoA": aoa(100, 900)}]
    adapted = parse_nrppa(message(item({"MultipleULAoA": {"multipleULAoA": choices}}), stations={"7": "bs3"}))
    assert len(adapted.report.measurements) == 2
    (skipped,) = adapted.skipped
    assert skipped.path[-2:] == (2, "uL-AoA")
    assert "repeats" in skipped.reason


@pytest.mark.parametrize(
    ("choice", "middle_tc", "step_tc"),
    [
        ({"k0": 985025}, 0.5, 1),
        ({"k1": 492943}, -985024 + 492942.5 * 2, 2),
        ({"k5": 1}, -985024 + 16, 32),
        ({"ReportingGranularitykminus6": 63041537}, 1 / 128, 1 / 64),
    ],
)
def test_an_arrival_is_the_middle_of_its_interval(choice: dict[str, int], middle_tc: float, step_tc: float):
    measured = only(message(item({"uL-RTOA": {"uLRTOAmeas": choice}}, timing_quality(3, "m1"))))
    assert isinstance(measured, TimeOfArrival)
    assert measured.path_length == pytest.approx(middle_tc * TC_M, abs=1e-8)
    assert measured.stdev == pytest.approx(math.sqrt(3.0**2 + (step_tc * TC_M) ** 2 / 12), rel=1e-12)


@pytest.mark.parametrize(
    ("value", "resolution", "stdev"),
    [(5, "m0dot1", 0.5), (1, "m10", 10.0), (31, "m30", 930.0), (0, "m1", 0.5), (0, "m0dot1", 0.05)],
)
def test_timing_quality_counts_steps_of_its_resolution(value: int, resolution: str, stdev: float):
    measured = only(message(item({"uL-RTOA": {"uLRTOAmeas": {"k0": 985025}}}, timing_quality(value, resolution))))
    assert measured.stdev == pytest.approx(math.sqrt(stdev**2 + TC_M**2 / 12), rel=1e-12)


def test_two_rx_tx_time_differences_make_a_range():
    document = message(
        item({"gNB-RxTxTimeDiff": {"rxTxTimeDiff": {"k0": 985024 + 5001}}}, timing_quality(5, "m0dot1")),
        ue_rx_tx=[
            {
                "tRP-ID": 7,
                "nr-UE-RxTxTimeDiff-r16": {"k1-r16": (985024 - 4900) // 2 + 1},
                "nr-TimingQuality-r16": {"timingQualityValue-r16": 2, "timingQualityResolution-r16": "m1"},
            },
            {"tRP-ID": 8, "nr-UE-RxTxTimeDiff-r16": {"k0-r16": 5}},
        ],
    )
    measured = only(document)
    assert isinstance(measured, Range)
    # gNB: 5000 to 5001 Tc; UE: -4900 to -4898 Tc; the round trip is 5000.5 - 4899 = 101.5 Tc.
    assert measured.path_length == pytest.approx(101.5 / 2 * TC_M, abs=1e-9)
    variance = (0.5**2 + TC_M**2 / 12) + (2.0**2 + (2 * TC_M) ** 2 / 12)
    assert measured.stdev == pytest.approx(math.sqrt(variance) / 2, rel=1e-12)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"gNB-RxTxTimeDiff": {"rxTxTimeDiff": {"k0": 985025}}}, "ue_rx_tx"),
        ({"uL-RTOA": {"uLRTOAmeas": {"k0": 0}}}, "beyond the range"),
        ({"uL-RTOA": {"uLRTOAmeas": {"k5": 61565}}}, "beyond the range"),
        ({"uL-SRS-RSRP": 60}, "powers"),
        ({"UL-RSCPMeas": {"uLRSCP": 5}}, "powers"),
        ({"ZoA": {"zenithAoA": 900}}, "without an azimuth"),
        ({"uL-AngleOfArrival": aoa(5, None, (0, 100, 0))}, "zenithAoA"),
    ],
)
def test_what_cannot_be_used_is_told(value: dict[str, Any], words: str):
    good = item({"uL-AngleOfArrival": aoa(412, 1035)})
    adapted = parse_nrppa(message(good, item(value)))
    assert len(adapted.report.measurements) == 1
    (skipped,) = adapted.skipped
    (kind,) = value
    assert skipped.path == (RESPONSE, 0, "measurementResult", 1, "measuredResultsValue", kind)
    assert words in skipped.reason
    with pytest.raises(InvalidReportError, match=words) as refused:
        parse_nrppa(message(item(value)))
    assert refused.value.path[-1] == kind


@pytest.mark.parametrize("paths", ["additionalPathList", "ExtendedAdditionalPathList"])
def test_additional_paths_count_from_the_first(paths: str):
    """Value v of k1 is the middle of -8175 + 2 (v - 1) to -8175 + 2 v Tc: 4096 is 16 Tc."""
    more = {"relativeTimeOfPath": {"k1": 4096}, "pathQuality": timing_quality(3, "m0dot1")}
    value = {"uLRTOAmeas": {"k0": 985025}, paths: [more]}
    adapted = parse_nrppa(message(item({"uL-RTOA": value}, timing_quality(5, "m0dot1"))))
    first, second = adapted.report.measurements
    assert isinstance(first, MeasuredPath)
    assert isinstance(second, MeasuredPath)
    assert first.clock == second.clock == "ue"
    assert first.length == pytest.approx(0.5 * TC_M, abs=1e-9)
    assert second.length - first.length == pytest.approx(16.0 * TC_M, abs=1e-9)
    assert first.stdev == pytest.approx(math.hypot(0.5, TC_M / math.sqrt(12.0)))
    assert second.stdev == pytest.approx(math.hypot(0.3, 2.0 * TC_M / math.sqrt(12.0)))
    assert adapted.sources[1][-2:] == (paths, 0)
    assert not adapted.skipped


def test_paths_have_their_angles_and_powers():
    """The TRP's only angle is of the first path."""
    more = {
        "relativeTimeOfPath": {"k0": 8300},
        "multipleULAoA": {"multipleULAoA": [{"uL-AoA": aoa(1200, 950)}, {"uL-AoA": aoa(1300, 950)}]},
        "pathPower": {"firstPathRSRPP": 70},
    }
    value = {"uLRTOAmeas": {"k0": 985025}, "ExtendedAdditionalPathList": [more]}
    adapted = parse_nrppa(
        message(
            item({"uL-AngleOfArrival": aoa(450, 900)}, angle_quality(20, 30)),
            item({"uL-RTOA": value}, **{"LoS-NLoSInformation": {"loS-NLoSIndicatorSoft": 3}}),
        )
    )
    first, second = adapted.report.measurements
    assert isinstance(first, MeasuredPath)
    assert isinstance(second, MeasuredPath)
    assert first.frame == second.frame == "north"
    assert first.azimuth == pytest.approx(math.radians(45.05))
    assert first.azimuth_stdev == pytest.approx(math.radians(math.hypot(2.0, 0.1 / math.sqrt(12.0))))
    assert second.azimuth == pytest.approx(math.radians(120.05))
    assert second.zenith == pytest.approx(math.radians(95.05))
    assert (first.power_db, second.power_db) == (None, 70.0)
    assert sorted(skip.path[-1] for skip in adapted.skipped) == ["LoS-NLoSInformation", "multipleULAoA"]


def test_times_without_additional_paths_are_paths_beside_them():
    """So that all are on one clock; ranges without additional paths stay ranges."""
    several = {"uLRTOAmeas": {"k0": 985025}, "additionalPathList": [{"relativeTimeOfPath": {"k0": 8300}}]}
    document = message(item({"uL-RTOA": several}))
    document[RESPONSE].append({"tRP-ID": 8, "measurementResult": [item({"uL-RTOA": {"uLRTOAmeas": {"k0": 985100}}})]})
    assert [type(m) for m in parse_nrppa(document).report.measurements] == [MeasuredPath] * 3


def test_a_round_trip_has_its_paths_on_a_known_clock():
    value = {"rxTxTimeDiff": {"k0": 985025}, "additionalPathList": [{"relativeTimeOfPath": {"k0": 8176}}]}
    ue = [{"tRP-ID": 7, "nr-UE-RxTxTimeDiff-r16": {"k0-r16": 985125}}]
    first, second = parse_nrppa(message(item({"gNB-RxTxTimeDiff": value}), ue_rx_tx=ue)).report.measurements
    assert isinstance(first, MeasuredPath)
    assert isinstance(second, MeasuredPath)
    assert first.clock == "known"
    assert first.length == pytest.approx(0.5 * (0.5 + 100.5) * TC_M, abs=1e-9)
    assert second.length == pytest.approx(first.length + 0.5 * TC_M, abs=1e-9)


@pytest.mark.parametrize("value", [0, 16351])
def test_a_path_beyond_the_range_is_skipped(value: int):
    several = {"uLRTOAmeas": {"k0": 985025}, "additionalPathList": [{"relativeTimeOfPath": {"k0": value}}]}
    adapted = parse_nrppa(message(item({"uL-RTOA": several})))
    assert len(adapted.report.measurements) == 1
    assert adapted.skipped[0].path[-1] == "relativeTimeOfPath"


@pytest.mark.parametrize(
    ("los", "probability"),
    [
        ({"loS-NLoSIndicatorSoft": 0}, 0.0),
        ({"loS-NLoSIndicatorSoft": 3}, 0.3),
        ({"loS-NLoSIndicatorSoft": 10}, 1.0),
        ({"loS-NLoSIndicatorHard": "nlos"}, 0.0),
        ({"loS-NLoSIndicatorHard": "los"}, 1.0),
    ],
)
@pytest.mark.parametrize(
    "value",
    [
        {"uL-AngleOfArrival": aoa(412, 1035)},
        {"MultipleULAoA": {"multipleULAoA": [{"uL-AoA": aoa(412, 1035)}, {"uL-AoA": aoa(900, 1035)}]}},
        {"uL-RTOA": {"uLRTOAmeas": {"k0": 985025}}},
    ],
)
def test_the_indicator_of_line_of_sight_is_of_all_measurements_of_its_item(
    value: dict[str, Any], los: dict[str, Any], probability: float
):
    plain = parse_nrppa(message(item(value)))
    adapted = parse_nrppa(message({**item(value), "LoS-NLoSInformation": los}))
    assert adapted == plain  # which does not compare it
    for before, after in zip(plain.report.measurements, adapted.report.measurements, strict=True):
        assert isinstance(before, Angle | TimeOfArrival)
        assert isinstance(after, Angle | TimeOfArrival)
        assert before.los_probability is None
        assert after.los_probability == probability


def test_a_measurement_report_is_as_good():
    response = message(item({"uL-AngleOfArrival": aoa(412, 1035)}), target_id="ue", timestamp="2026-01-31T10:00:00Z")
    report = {("TRP-MeasurementReportList" if key == RESPONSE else key): value for key, value in response.items()}
    report["LMF-Measurement-ID"] = 5
    assert parse_nrppa(report).report == parse_nrppa(response).report
    assert parse_nrppa(report).report.target_id == "ue"
    assert parse_nrppa(report).report.timestamp == "2026-01-31T10:00:00Z"


def test_a_known_height_is_passed_on():
    document = message(item({"uL-AngleOfArrival": aoa(412, 1035)}), height={"z_m": 1.2, "stdev_m": 0.1})
    assert parse_nrppa(document).report.height == Height(z=1.2, stdev=0.1)
    with pytest.raises(InvalidReportError, match=r"height\.stdev_m is 0; give a positive standard deviation"):
        parse_nrppa({**document, "height": {"z_m": 1.2, "stdev_m": 0}})


def test_right_at_the_zenith_an_azimuth_is_unknown():
    # Azimuth 0.05 and zenith 90.05 deg, turned by 270.1 deg about y: 0.07 deg from straight up.
    measured = only(message(item({"uL-AngleOfArrival": aoa(0, 900, (0, 2701, 0))}, angle_quality(10, 10))))
    assert measured.zenith < math.radians(0.2)
    assert 1.0 < measured.azimuth_stdev <= 2 * math.pi
    assert abs(measured.correlation) <= 0.999


def test_the_messages_own_map_comes_first():
    document = message(item({"uL-AngleOfArrival": aoa(412, 1035)}), stations={"7": "bs3"})
    assert parse_nrppa(document, stations={"7": "bs1"}).report.measurements[0].station_id == "bs3"
    del document["stations"]
    assert parse_nrppa(document, stations={"7": "bs1"}).report.measurements[0].station_id == "bs1"


MESSAGE = message(
    item({"uL-AngleOfArrival": aoa(412, 1035, (0, 0, 0))}, angle_quality(10, 10)),
    item({"uL-RTOA": {"uLRTOAmeas": {"k1": 492943}}}, timing_quality(5, "m0dot1")),
    ue_rx_tx=[{"tRP-ID": 7, "nr-UE-RxTxTimeDiff-r16": {"k0-r16": 985024}}],
)
AOA_VALUE = f"['{RESPONSE}'][0].measurementResult[0].measuredResultsValue"


def set_at(document: Any, *path: Any) -> dict[str, Any]:
    """Copy a document and set what a path leads to; the last step is the value."""
    changed = copy.deepcopy(document)
    at = changed
    for step in path[:-2]:
        at = at[step]
    at[path[-2]] = path[-1]
    return changed


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ((RESPONSE, 0, "tRP-ID", 0), f"['{RESPONSE}'][0]['tRP-ID'] is 0; give a TRP-ID, an integer from 1 to 65535"),
        ((RESPONSE, 0, "tRP-ID", "7"), "is the text '7'; give a TRP-ID"),
        ((RESPONSE, 0, "measurementResult", []), "is an array of length 0; give an array of 1 to 256 measurements"),
        ((RESPONSE, []), "is an array of length 0; give an array of 1 to 64"),
        ((RESPONSE, 0, 5), f"['{RESPONSE}'][0] is 5; give a JSON object"),
        ((RESPONSE, 0, "cell", 5), f"['{RESPONSE}'][0].cell is an unknown key"),
        (
            (RESPONSE, 0, "measurementResult", 0, "measuredResultsValue", "uL-AngleOfArrival", "azimuthAoA", 3600),
            f"{AOA_VALUE}['uL-AngleOfArrival'].azimuthAoA is 3600; "
            "give an azimuth in 0.1 deg, an integer from 0 to 3599",
        ),
        (
            (RESPONSE, 0, "measurementResult", 0, "measuredResultsValue", "uL-AngleOfArrival", "zenitAoA", 5),
            f"{AOA_VALUE}['uL-AngleOfArrival'].zenitAoA is an unknown key; did you mean zenithAoA?",
        ),
        (
            (RESPONSE, 0, "measurementResult", 0, "measuredResultsValue", "uL-AngleOfArrival", "zenithAoA", 90.5),
            "zenithAoA is 90.5; give a zenith angle in 0.1 deg, an integer from 0 to 1799",
        ),
        ((RESPONSE, 0, "measurementResult", 0, "measuredResultsValue", {}), f"{AOA_VALUE} holds nothing; give exactly"),
        (
            (RESPONSE, 0, "measurementResult", 1, "measuredResultsValue", "uL-RTOA", "uLRTOAmeas", "k0", 5),
            "uLRTOAmeas holds k0 and k1; give exactly one of k0, k1",
        ),
        (
            (RESPONSE, 0, "measurementResult", 1, "measuredResultsValue", "uL-RTOA", "uLRTOAmeas", "k1", 985026),
            "k1 is 985026; give a time in steps of Tc * 2^1, an integer from 0 to 985025",
        ),
        (
            (RESPONSE, 0, "measurementResult", 1, "measurementQuality", "timingMeasQuality", "resolution", "m5"),
            "resolution is 'm5'; give one of m0dot1, m1, m10, m30",
        ),
        (
            (RESPONSE, 0, "measurementResult", 1, "LoS-NLoSInformation", {"loS-NLoSIndicatorHard": "maybe"}),
            "is 'maybe'; give one of nlos, los",
        ),
        (("ue_rx_tx", 0, "nr-UE-RxTxTimeDiff-r16", {"k6-r16": 1}), "'k6-r16'] is an unknown key"),
        (("stations", {"7": 5}), "stations['7'] is 5; give an object of station identifiers"),
        (("timestamp", "yesterday"), "timestamp is 'yesterday'; give an RFC 3339 date-time"),
        (("angle_stdev_deg", 0), "angle_stdev_deg is 0; give a standard deviation"),
        (("azimuth_zero_deg", 90), "azimuth_zero_deg is 90; give 0 or -180"),
        (("TRP-MeasurementReportList", MESSAGE[RESPONSE]), "has both lists; give exactly one of"),
    ],
)
def test_refusals_name_the_field_and_the_remedy(path: tuple[Any, ...], words: str):
    with pytest.raises(InvalidReportError) as refused:
        parse_nrppa(set_at(MESSAGE, *path))
    assert words in str(refused.value)


def test_a_message_without_measurements_is_refused():
    with pytest.raises(InvalidReportError, match="has no measurements; give exactly one of TRP-Measurement"):
        parse_nrppa({})
    with pytest.raises(InvalidReportError, match="the NRPPa message is an array of length 0; give a JSON object"):
        parse_nrppa(b"[]")
    with pytest.raises(MalformedJsonError):
        parse_nrppa(b"{")


def test_too_many_measurements_are_refused():
    document = {
        RESPONSE: [{"tRP-ID": n, "measurementResult": [item({"uL-AngleOfArrival": aoa(5, 900)})] * 200} for n in (1, 2)]
    }
    with pytest.raises(InvalidReportError, match="400 measurements; give at most 256"):
        parse_nrppa(document)


def pdu(
    content: dict[str, Any], *, outcome: str = "successfulOutcome", name: str = "MeasurementResponse"
) -> dict[str, Any]:
    """Wrap the lists of a message into a PDU, among elements that are not read."""
    elements = [{"id": 41, "criticality": "reject", "value": {"LMF-Measurement-ID": 1}}]
    elements += [{"id": 43, "criticality": "reject", "value": {key: value}} for key, value in content.items()]
    elements.append({"id": 7, "criticality": "ignore", "value": {"CriticalityDiagnostics": {}}})
    inner = {name: {"protocolIEs": elements}}
    return {outcome: {"procedureCode": 14, "criticality": "reject", "nrppatransactionID": 9, "value": inner}}


@pytest.mark.parametrize(
    ("outcome", "name", "key"),
    [
        ("successfulOutcome", "MeasurementResponse", RESPONSE),
        ("initiatingMessage", "MeasurementReport", "TRP-MeasurementReportList"),
    ],
)
def test_a_whole_pdu_is_unwrapped(outcome: str, name: str, key: str):
    """What only the location server knows stands beside it."""
    content = {key: message(item({"uL-AngleOfArrival": aoa(123, 900)}))[RESPONSE]}
    beside = {"target_id": "ue-7", "stations": {"7": "bs1"}}
    assert parse_nrppa({**pdu(content, outcome=outcome, name=name), **beside}) == parse_nrppa({**content, **beside})


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({"unsuccessfulOutcome": {}}, "unsuccessfulOutcome reports that the measurement failed"),
        (pdu({}, name="PositioningInformationResponse"), "holds PositioningInformationResponse; give one with Meas"),
        ({"successfulOutcome": {"value": 3}}, "has no array protocolIEs"),
        ({"successfulOutcome": []}, "has no array protocolIEs"),
        (pdu({}), "has no measurements"),
    ],
)
def test_other_pdus_are_refused(document: dict[str, Any], words: str):
    with pytest.raises(InvalidReportError, match=words):
        parse_nrppa(document)


def test_a_byte_order_mark_is_passed_over():
    content = message(item({"uL-AngleOfArrival": aoa(123, 900)}))
    text = json.dumps(content).encode()
    assert parse_nrppa(b"\xef\xbb\xbf" + text) == parse_nrppa(text)
