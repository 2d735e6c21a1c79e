"""Examples of the OpenAPI document. They are of the bundled hall and answer 200 there."""

from typing import Any


def _aoa(station_id: str, azimuth_deg: float, zenith_deg: float) -> dict[str, Any]:
    return {
        "type": "aoa",
        "station_id": station_id,
        "azimuth_deg": azimuth_deg,
        "zenith_deg": zenith_deg,
        "azimuth_stdev_deg": 1.0,
        "zenith_stdev_deg": 1.0,
    }


# All measurements have a line of sight to (7.0, 4.0, 1.5), and errors of the size of their deviations.
_AOA_1 = _aoa("bs1", 29.9, 96.1)
_AOA_2 = _aoa("bs2", 102.4, 103.3)
_AOA_3 = _aoa("bs3", -93.2, 93.1)

REPORT_EXAMPLES: dict[str, dict[str, Any]] = {
    "angle_and_time": {
        "summary": "One station: its angle of arrival and propagation time",
        "value": {
            "target_id": "agv-7",
            "timestamp": "2026-01-31T10:00:00.250Z",
            "measurements": [_AOA_1, {"type": "pt", "station_id": "bs1", "range_m": 7.8, "stdev_m": 0.5}],
        },
    },
    "angles": {
        "summary": "Three stations: angles of arrival alone",
        "value": {"target_id": "agv-7", "measurements": [_AOA_1, _AOA_2, _AOA_3]},
    },
    "time_differences": {
        "summary": "An angle of arrival, and time differences to its station, in metres or nanoseconds",
        "value": {
            "measurements": [
                _AOA_1,
                {
                    "type": "tdoa",
                    "station_id": "bs2",
                    "reference_station_id": "bs1",
                    "range_difference_m": -4.1,
                    "stdev_m": 0.5,
                },
                {
                    "type": "tdoa",
                    "station_id": "bs3",
                    "reference_station_id": "bs1",
                    "delay_difference_ns": 20.8,
                    "stdev_ns": 1.7,
                },
            ]
        },
    },
    "several_paths": {
        "summary": "Two paths of one station, on the UE's clock",
        "value": {
            "measurements": [
                {**_AOA_1, "type": "path", "toa_m": 132.8, "stdev_m": 0.3, "power_db": -61.0},
                {**_aoa("bs1", 36.2, 95.5), "type": "path", "toa_m": 133.9, "stdev_m": 0.3, "power_db": -67.5},
            ]
        },
    },
    "selection": {
        "summary": "A station that reports the first path to arrive",
        "value": {
            "selection": {"rule": "first"},
            "measurements": [_AOA_1, {"type": "pt", "station_id": "bs1", "range_m": 7.8, "stdev_m": 0.5}],
        },
    },
    "unsynchronised_clock": {
        "summary": "Angles, and times of arrival with a common unknown clock offset",
        "value": {
            "measurements": [
                _AOA_1,
                _AOA_2,
                {"type": "toa", "station_id": "bs1", "range_m": 131.2, "stdev_m": 0.5},
                {"type": "toa", "station_id": "bs2", "range_m": 127.0, "stdev_m": 0.5},
            ]
        },
    },
    "azimuth_only": {
        "summary": "Sensors that measure no zenith angle, and count azimuths up to 360",
        "value": {
            "target_id": "tag-61cf",
            "measurements": [
                {"type": "aoa", "station_id": "bs1", "azimuth_deg": 31.0, "azimuth_stdev_deg": 5.0},
                {"type": "aoa", "station_id": "bs3", "azimuth_deg": 263.0, "azimuth_stdev_deg": 5.0},
                {"type": "pt", "station_id": "bs2", "delay_ns": 13.4, "stdev_ns": 1.7},
            ],
        },
    },
    "bluetooth": {
        "summary": "A tag at a known height: rough angles with outliers, a round trip, a signal strength",
        "value": {
            "target_id": "tag-61cf",
            "height": {"z_m": 1.5, "stdev_m": 0.2},
            "measurements": [
                {
                    **_aoa("bs1", 33.0, 98.0),
                    "azimuth_stdev_deg": 5.0,
                    "zenith_stdev_deg": 5.0,
                    "correlation": 0.2,
                    "error_model": "heavy_tailed",
                },
                {
                    "type": "pt",
                    "station_id": "bs2",
                    "round_trip_ns": 300027.0,
                    "reply_ns": 300000.0,
                    "stdev_ns": 3.4,
                    "error_model": "heavy_tailed",
                    "tail_share": 0.2,
                    "tail_scale": 4.0,
                },
                {
                    "type": "rssi",
                    "station_id": "bs3",
                    "rssi_dbm": -65.0,
                    "power_at_1m_dbm": -42.0,
                    "path_loss_exponent": 2.0,
                    "shadowing_stdev_db": 4.0,
                },
            ],
        },
    },
}
"""Bodies of ``POST /v1/positions``."""

BATCH_EXAMPLES: dict[str, dict[str, Any]] = {
    "two_reports": {
        "summary": "Two reports",
        "value": {"reports": [REPORT_EXAMPLES["angle_and_time"]["value"], REPORT_EXAMPLES["angles"]["value"]]},
    },
}
"""Bodies of ``POST /v1/positions/batch``."""

_POSITION = {"x": 6.81, "y": 3.94, "z": 1.57}
_COVARIANCE = [[0.165, 0.085, -0.018], [0.085, 0.07, -0.01], [-0.018, -0.01, 0.023]]

FIX_EXAMPLE: dict[str, Any] = {
    "target_id": "agv-7",
    "timestamp": "2026-01-31T10:00:00.250Z",
    "status": "ok",
    "position": _POSITION,
    "covariance_m2": _COVARIANCE,
    "horizontal_accuracy_m": 0.48,
    "vertical_accuracy_m": 0.15,
    "ellipsoid_semi_axes_m": [[-0.748, -0.439, 0.092], [-0.041, 0.12, 0.24], [-0.13, 0.196, -0.12]],
    "confidence": 0.68,
    "candidates": [
        {"probability": 0.986, "position": _POSITION, "covariance_m2": _COVARIANCE},
        {
            "probability": 0.012,
            "position": {"x": 6.82, "y": 4.2, "z": 2.08},
            "covariance_m2": [[0.123, 0.045, 0.009], [0.045, 0.05, 0.003], [0.009, 0.003, 0.008]],
        },
    ],
    "measurements": [
        {"index": 0, "used": True, "outlier_probability": 0.0},
        {"index": 1, "used": True, "outlier_probability": 0.002},
    ],
    "table_id": "5c3b1f0e9d8a7766554433221100ffeeddccbbaa99887766554433221100ffee",
    "compute_ms": 1.6,
}
"""An answer to the first report."""

FIX_EVENT_EXAMPLE: dict[str, Any] = {
    "table": "hall",
    "report": REPORT_EXAMPLES["angle_and_time"]["value"],
    "fix": FIX_EXAMPLE,
}
"""The data of an event of ``GET /v1/fixes``."""

_MESSAGE = "measurements[0].azimuth_stdev_deg is -1; give a positive standard deviation in degrees, 1e-06 to 360"

PROBLEM_EXAMPLE: dict[str, Any] = {
    "type": "urn:rayfix:problem:invalid-report",
    "title": "Report cannot be used",
    "status": 422,
    "detail": _MESSAGE,
    "errors": [{"path": "measurements[0].azimuth_stdev_deg", "message": _MESSAGE}],
}
"""The answer to a report that cannot be used."""


def _ul_aoa(azimuth: int, zenith: int) -> dict[str, Any]:
    return {
        "measuredResultsValue": {"uL-AngleOfArrival": {"azimuthAoA": azimuth, "zenithAoA": zenith}},
        "measurementQuality": {
            "angleMeasQuality": {"azimuthQuality": 10, "zenithQuality": 10, "resolution": "deg0dot1"}
        },
    }


_TIMING = {"timingMeasQuality": {"measurementQuality": 5, "resolution": "m0dot1"}}
_TRPS = {"1": "bs1", "2": "bs2", "3": "bs3"}

# The same directions: the hall's +y axis points north, so that azimuths from there are 90 deg less.
NRPPA_EXAMPLES: dict[str, dict[str, Any]] = {
    "ul_aoa_and_ul_rtoa": {
        "summary": "UL-AoA and UL-RTOA of two TRPs",
        "value": {
            "target_id": "ue-7",
            "stations": _TRPS,
            "TRP-MeasurementResponseList": [
                {
                    "tRP-ID": 1,
                    "measurementResult": [
                        _ul_aoa(2999, 960),
                        {
                            "measuredResultsValue": {"uL-RTOA": {"uLRTOAmeas": {"k1": 492943}}},
                            "measurementQuality": _TIMING,
                        },
                    ],
                },
                {
                    "tRP-ID": 2,
                    "measurementResult": [
                        _ul_aoa(124, 1033),
                        {
                            "measuredResultsValue": {"uL-RTOA": {"uLRTOAmeas": {"k1": 492929}}},
                            "measurementQuality": _TIMING,
                        },
                    ],
                },
            ],
        },
    },
    "multi_rtt": {
        "summary": "UL-AoA of two TRPs, and the round trip to one of them",
        "value": {
            "target_id": "ue-7",
            "stations": _TRPS,
            "TRP-MeasurementResponseList": [
                {
                    "tRP-ID": 1,
                    "measurementResult": [
                        _ul_aoa(2999, 960),
                        {
                            "measuredResultsValue": {"gNB-RxTxTimeDiff": {"rxTxTimeDiff": {"k0": 990025}}},
                            "measurementQuality": _TIMING,
                        },
                    ],
                },
                {"tRP-ID": 3, "measurementResult": [_ul_aoa(1768, 931)]},
            ],
            "ue_rx_tx": [
                {
                    "tRP-ID": 1,
                    "nr-UE-RxTxTimeDiff-r16": {"k0-r16": 980127},
                    "nr-TimingQuality-r16": {"timingQualityValue-r16": 5, "timingQualityResolution-r16": "mdot1"},
                }
            ],
        },
    },
}
"""Bodies of ``POST /v1/positions/nrppa``."""

NRPPA_BATCH_EXAMPLES: dict[str, dict[str, Any]] = {
    "one_message": {
        "summary": "A batch of one message",
        "value": {"reports": [NRPPA_EXAMPLES["ul_aoa_and_ul_rtoa"]["value"]]},
    },
}
"""Bodies of ``POST /v1/positions/nrppa/batch``."""


def _silabs(locator_id: str, azimuth: float, elevation: float) -> dict[str, Any]:
    return {
        "locator_id": locator_id,
        "azimuth": azimuth,
        "azimuth_stdev": 1.2,
        "elevation": elevation,
        "elevation_stdev": 1.1,
        "distance": 0.0,
        "distance_stdev": 0.0,
        "sequence": 4711,
    }


# The hall's stations are turned by 45, 135 and -135 deg; clockwise azimuths count from there.
SILABS_EXAMPLES: dict[str, dict[str, Any]] = {
    "three_locators": {
        "summary": "One packet, received by three locators",
        "value": {
            "target_id": "ble-pd-60A423C96B9A",
            "stations": {"ble-pd-0C4314F46CDC": "bs1", "ble-pd-0C4314F46D0B": "bs2", "ble-pd-0C4314F46B25": "bs3"},
            "angles": [
                _silabs("ble-pd-0C4314F46CDC", 15.1, -6.1),
                _silabs("ble-pd-0C4314F46D0B", 32.6, -13.3),
                _silabs("ble-pd-0C4314F46B25", -41.8, -3.1),
            ],
        },
    }
}
"""Bodies of ``POST /v1/positions/silabs``."""

SILABS_BATCH_EXAMPLES: dict[str, dict[str, Any]] = {
    "one_message": {
        "summary": "A batch of one message",
        "value": {"reports": [SILABS_EXAMPLES["three_locators"]["value"]]},
    },
}
"""Bodies of ``POST /v1/positions/silabs/batch``."""

UBLOX_EXAMPLES: dict[str, dict[str, Any]] = {
    "three_anchors": {
        "summary": "One transmission of a tag, received by three anchors whose ids are those of stations",
        "value": """\
+UUDF:6C1DEBA5F60C,-53,15,-6,0,37,"bs1","",1437347,40871
+UUDF:6C1DEBA5F60C,-50,33,-13,0,37,"bs2","",238777,40871
+UUDF:6C1DEBA5F60C,-61,-42,-3,0,37,"bs3","",1129320,40871
""",
    }
}
"""Bodies of ``POST /v1/positions/ublox``."""

_OUTCOMES = ("uL-AngleOfArrival", "uL-RTOA")

ADAPTED_FIX_EXAMPLE: dict[str, Any] = {
    **FIX_EXAMPLE,
    "target_id": "ue-7",
    "timestamp": None,
    "measurements": [
        {
            "index": n,
            "used": True,
            "outlier_probability": 0.0,
            "source": f"['TRP-MeasurementResponseList'][0].measurementResult[{n}].measuredResultsValue['{name}']",
        }
        for n, name in enumerate(_OUTCOMES)
    ],
    "skipped": [],
}
"""An answer to a message of another format."""

LOCAL_3D_EXAMPLE: dict[str, Any] = {
    "shape": "LOCAL_3D_POINT_UNCERTAINTY_ELLIPSOID",
    "localOrigin": {"coordinateId": "hall", "horizAxesOrientation": 0},
    "point": _POSITION,
    "uncertaintyEllipsoid": {"semiMajor": 0.86, "semiMinor": 0.27, "vertical": 0.28, "orientationMajor": 60},
    "confidence": 68,
}
"""An answer with ``output=3gpp``."""

OMLOX_EXAMPLE: dict[str, Any] = {
    "position": {"type": "Point", "coordinates": [6.81, 3.94, 1.57]},
    "source": "hall",
    "provider_type": "unknown",
    "provider_id": "agv-7",
    "crs": "local",
    "accuracy": 0.48,
    "elevation_ref": "floor",
    "floor": 0,
    "properties": {
        "rayfix.status": "ok",
        "rayfix.probability": 0.986,
        "rayfix.vertical_accuracy_m": 0.15,
        "rayfix.covariance_m2": _COVARIANCE,
        "rayfix.table_id": FIX_EXAMPLE["table_id"],
    },
    "timestamp_generated": "2026-01-31T10:00:00.250Z",
}
"""An answer with ``output=omlox``."""
