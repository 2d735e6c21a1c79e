"""What a calibration found of a station, in the table file."""

import json

import pytest

from rayfix_tables.disk.calibrated import CALIBRATION, calibration_text, read_calibration
from rayfix_tables.site import Deviations, Station

FOUND = Deviations(azimuth=0.1, correlation_time=1.5, correlated_share=0.6)
STATION = Station(id="a", position=(0.0, 0.0, 2.0), deviations=FOUND)


def document() -> dict[str, dict[str, object]]:
    text = calibration_text(STATION)
    assert text is not None
    found: dict[str, dict[str, object]] = json.loads(text)
    return found


def test_the_drift_of_errors_comes_back() -> None:
    assert read_calibration({CALIBRATION: calibration_text(STATION)}) == (None, FOUND)


def test_tables_of_before_have_no_drift() -> None:
    older = document()
    del older["deviations"]["correlation_time"], older["deviations"]["correlated_share"]
    assert read_calibration({CALIBRATION: json.dumps(older)}) == (None, Deviations(azimuth=0.1))


@pytest.mark.parametrize(
    ("name", "value"),
    [("correlation_time", 0.0), ("correlation_time", "1"), ("correlated_share", 1.01), ("correlated_share", -0.1)],
)
def test_a_drift_out_of_range_is_damage(name: str, value: object) -> None:
    damaged = document()
    damaged["deviations"][name] = value
    with pytest.raises(ValueError, match=r"calibration of a station|drift of a station"):
        read_calibration({CALIBRATION: json.dumps(damaged)})
