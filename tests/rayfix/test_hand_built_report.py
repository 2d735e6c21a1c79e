"""Reports that are built in Python."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import rayfix
from tests.support.checkout import ROOT

ANGLE = rayfix.Angle(station_id="bs1", azimuth=1.23, azimuth_stdev=0.02, zenith=1.69, zenith_stdev=0.02)
RANGE = rayfix.Range(station_id="bs1", path_length=14.5, stdev=0.5)
REPORT = rayfix.Report(measurements=(ANGLE, RANGE), height=rayfix.Height(z=0.7, stdev=0.2))


@pytest.fixture(scope="module")
def locator(hall_table_path: Path) -> rayfix.Locator:
    return rayfix.Locator(rayfix.Table.open(hall_table_path))


def test_the_example_of_the_documentation_runs(hall_table_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs" / "measurements.md").read_text(encoding="utf-8")
    section = text[text.index("## In Python") : text.index("## Angle of arrival")]
    (code,) = re.findall(r"```python\n(.*?)```", section, flags=re.DOTALL)
    assert code.count("demo/hall.h5") == 1
    names: dict[str, Any] = {}
    exec(code.replace("demo/hall.h5", str(hall_table_path)), names)
    status, radius = capsys.readouterr().out.splitlines()
    assert status.startswith("ok")
    assert 0.1 < float(radius) < 1.5
    assert names["fix"].target_id == "agv-7"


def test_a_report_built_by_hand_is_that_of_the_json(locator: rayfix.Locator) -> None:
    report = rayfix.Report(
        measurements=(
            rayfix.Angle(station_id="bs1", azimuth=math.radians(70.5), azimuth_stdev=math.radians(2.0)),
            rayfix.TimeOfArrival(station_id="bs1", path_length=30.0, stdev=0.5, error_model=rayfix.HEAVY_TAILED),
            rayfix.TimeOfArrival(station_id="bs2", path_length=29.9, stdev=0.5),
        )
    )
    document = {
        "measurements": [
            {"type": "aoa", "station_id": "bs1", "azimuth_deg": 70.5, "azimuth_stdev_deg": 2.0},
            {"type": "toa", "station_id": "bs1", "range_m": 30.0, "stdev_m": 0.5, "error_model": "heavy_tailed"},
            {"type": "toa", "station_id": "bs2", "range_m": 29.9, "stdev_m": 0.5},
        ]
    }
    by_hand, from_json = locator.locate(report), locator.locate(document)
    assert by_hand.log_evidence == pytest.approx(from_json.log_evidence, rel=1e-12)
    assert by_hand.status == from_json.status


WRONG: list[tuple[rayfix.Report, tuple[str | int, ...]]] = [
    (replace(REPORT, measurements=(replace(ANGLE, azimuth=math.nan),)), ("measurements", 0, "azimuth")),
    (replace(REPORT, measurements=(replace(ANGLE, azimuth=70.5),)), ("measurements", 0, "azimuth")),
    (replace(REPORT, measurements=(RANGE, replace(ANGLE, azimuth_stdev=0.0))), ("measurements", 1, "azimuth_stdev")),
    (replace(REPORT, measurements=(replace(ANGLE, zenith=-0.1),)), ("measurements", 0, "zenith")),
    (replace(REPORT, measurements=(replace(ANGLE, zenith_stdev=None),)), ("measurements", 0, "zenith_stdev")),
    (replace(REPORT, measurements=(replace(ANGLE, correlation=1.0),)), ("measurements", 0, "correlation")),
    (replace(REPORT, measurements=(replace(RANGE, stdev=-0.5),)), ("measurements", 0, "stdev")),
    (replace(REPORT, measurements=(replace(RANGE, path_length=math.inf),)), ("measurements", 0, "path_length")),
    (replace(REPORT, measurements=(replace(RANGE, los_probability=1.5),)), ("measurements", 0, "los_probability")),
    (replace(REPORT, measurements=(replace(RANGE, stdev="0.5"),)), ("measurements", 0, "stdev")),  # type: ignore[arg-type]
    (
        replace(REPORT, measurements=(replace(RANGE, error_model=rayfix.ErrorModel(tail_share=1.0)),)),
        ("measurements", 0, "error_model", "tail_share"),
    ),
    (
        replace(REPORT, measurements=(replace(RANGE, error_model=rayfix.ErrorModel(tail_share=0.1, tail_scale=0.5)),)),
        ("measurements", 0, "error_model", "tail_scale"),
    ),
    (
        replace(REPORT, measurements=(rayfix.LogRange(station_id="bs1", path_length=0.0, log_stdev=0.3),)),
        ("measurements", 0, "path_length"),
    ),
    (replace(REPORT, measurements=({"type": "pt"},)), ("measurements", 0)),  # type: ignore[arg-type]
    (replace(REPORT, height=rayfix.Height(z=0.7, stdev=0.0)), ("height", "stdev")),
    (replace(REPORT, confidence=68.0), ("confidence",)),
]


@pytest.mark.parametrize(("report", "path"), WRONG, ids=[".".join(map(str, path)) for _, path in WRONG])
def test_a_number_out_of_its_range_names_the_field(
    locator: rayfix.Locator, report: rayfix.Report, path: tuple[str | int, ...]
) -> None:
    for ask in (locator.locate, locator.fuse, locator.posterior):
        with pytest.raises(rayfix.ReportError, match="; give ") as found:
            ask(report)
        assert found.value.path == path
    fix, error = locator.locate_batch([REPORT, report], jobs=1)
    assert isinstance(fix, rayfix.Fix)
    assert isinstance(error, rayfix.ReportError)
    assert error.path == path


def test_what_is_within_its_ranges_is_located(locator: rayfix.Locator) -> None:
    fix = locator.locate(replace(REPORT, measurements=(replace(ANGLE, correlation=0.5, los_probability=1.0), RANGE)))
    assert fix.status == "ok"
