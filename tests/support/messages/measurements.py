"""Measurements of the wire, one of each kind."""

from typing import Any

AOA = {"type": "aoa", "station_id": "bs1", "azimuth_deg": 41.2, "azimuth_stdev_deg": 1.0}
PT = {"type": "pt", "station_id": "bs1", "range_m": 7.9, "stdev_m": 0.5}
TOA = {"type": "toa", "station_id": "bs2", "range_m": 131.0, "stdev_m": 0.5}
TDOA = {
    "type": "tdoa",
    "station_id": "bs3",
    "reference_station_id": "bs1",
    "range_difference_m": 2.1,
    "stdev_m": 0.7,
}
RSSI = {
    "type": "rssi",
    "station_id": "bs1",
    "rssi_dbm": -61.0,
    "power_at_1m_dbm": -42.0,
    "path_loss_exponent": 2.0,
    "shadowing_stdev_db": 4.0,
}


def report_with(measurement: dict[str, Any], *without: str, **values: Any) -> dict[str, Any]:
    """Report of one measurement, with some keys left out and others set."""
    kept = {key: value for key, value in measurement.items() if key not in without}
    return {"measurements": [{**kept, **values}]}
