"""Fixes of a log in a page: all of them, with reports and true positions, or one error."""

import json
from pathlib import Path

import pytest

from rayfix.cli import main
from rayfix.errors import ViewError
from rayfix.viewing.recording import MOST_FIXES, read_recording
from rayfix_tables.errors import ReportError
from tests.support.messages.reports import REPORT

FIX = {"status": "ok", "position": None, "candidates": [], "measurements": [], "target_id": "a"}


def lines(path: Path, *fixes: dict) -> Path:
    path.write_text("".join(json.dumps(fix) + "\n" for fix in fixes), encoding="utf-8")
    return path


def test_fixes_are_located_with_their_reports_and_played_beside_the_truth(hall_table_path: Path, tmp_path: Path):
    reports = [
        {
            **REPORT,
            "target_id": "a",
            "timestamp": f"2026-01-31T10:00:0{second}Z",
            "measurements": REPORT["measurements"],
        }
        for second in range(3)
    ]
    log, fixes = lines(tmp_path / "log.jsonl", *reports), tmp_path / "fixes.jsonl"
    command = ["locate", str(hall_table_path), str(log), "-o", str(fixes), "--jobs", "1", "--no-progress"]
    assert main([*command, "--with-reports"]) == 0
    truth = tmp_path / "truth.csv"
    truth.write_text(
        "timestamp,x_m,y_m,z_m\n2026-01-31T10:00:00Z,1,2,1\n2026-01-31T10:00:01Z,3,2,1\n", encoding="utf-8"
    )
    recording = read_recording(fixes, truth)
    assert [event.get("truth") for event in recording["events"]] == [[1.0, 2.0, 1.0], [3.0, 2.0, 1.0], None]
    for event, report in zip(recording["events"], reports, strict=True):
        assert event["fix"]["timestamp"] == report["timestamp"]
        assert len(event["report"]["measurements"]) == len(report["measurements"])
        assert "horizontal_radii_m" not in event["fix"]
    assert recording["name"] == "fixes.jsonl"


def test_without_reports_fixes_are_played_all_the_same(tmp_path: Path):
    (event,) = read_recording(lines(tmp_path / "f.jsonl", FIX))["events"]
    assert event == {"report": {"measurements": []}, "fix": FIX, "source": "log"}


@pytest.mark.parametrize("text", ["{", "[]", '{"status": "ok"}', '{"type": "FeatureCollection"}'])
def test_a_line_that_is_no_fix_is_named(tmp_path: Path, text: str):
    path = lines(tmp_path / "f.jsonl", FIX)
    path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")
    with pytest.raises(ViewError, match=r"line 2 is no fix; give a file that 'rayfix locate"):
        read_recording(path)


def test_nothing_and_too_much_are_refused(tmp_path: Path):
    with pytest.raises(ViewError, match="holds no fixes"):
        read_recording(lines(tmp_path / "none.jsonl"))
    with pytest.raises(ViewError, match=f"more than {MOST_FIXES} fixes"):
        read_recording(lines(tmp_path / "many.jsonl", *[FIX] * (MOST_FIXES + 1)))
    with pytest.raises(ReportError, match="No such file"):
        read_recording(tmp_path / "missing.jsonl")


def test_a_truth_of_another_time_is_refused(tmp_path: Path):
    truth = tmp_path / "truth.csv"
    truth.write_text("timestamp,x_m,y_m,z_m\n2026-01-31T10:00:00Z,1,2,1\n", encoding="utf-8")
    fixes = lines(tmp_path / "f.jsonl", {**FIX, "timestamp": "2025-01-31T10:00:00Z"})
    with pytest.raises(ViewError, match="no true position at the times"):
        read_recording(fixes, truth)


@pytest.mark.parametrize(
    ("output", "more"), [("fixes.csv", []), ("fixes.geojson", []), ("fixes.jsonl", ["--output", "omlox"])]
)
def test_reports_go_into_json_lines_only(
    hall_table_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], output: str, more: list[str]
):
    log = lines(tmp_path / "log.jsonl", REPORT)
    command = ["locate", str(hall_table_path), str(log), "-o", str(tmp_path / output), "--with-reports", *more]
    assert main(command) == 2
    assert "--with-reports is for fixes as JSON lines" in capsys.readouterr().err


def test_a_truth_needs_fixes(hall_table_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    page, truth = str(tmp_path / "page.html"), str(tmp_path / "t.csv")
    assert main(["view", str(hall_table_path), "-o", page, "--truth", truth]) == 2
    assert "give them by --fixes" in capsys.readouterr().err
