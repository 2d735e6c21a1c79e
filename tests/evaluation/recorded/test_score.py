"""The truth at a time, and figures of fixes that can be counted by hand."""

from pathlib import Path

import numpy as np
import pytest

from rayfix_evaluation.recorded.page import score_page, score_picture
from rayfix_evaluation.recorded.score import ScoredFixes, score_document
from rayfix_evaluation.recorded.truth import read_truth
from rayfix_tables.errors import ReportError


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_stays(tmp_path: Path) -> None:
    truth = read_truth(
        written(tmp_path / "t.csv", "start_ms,end_ms,x_m,y_m,z_m,note\n1000,2000,1,2,3,a\n3000,4000,4,5,6,b\n")
    )
    assert truth.unread == ("note",)
    found = truth.at("anyone", 3.5)
    assert found is not None
    assert (found[0].tolist(), found[1]) == ([4.0, 5.0, 6.0], 1)
    assert truth.at(None, 2.5) is None


def test_paths_of_targets(tmp_path: Path) -> None:
    text = (
        "timestamp,target_id,x_m,y_m,z_m\n"
        "1970-01-01T00:00:10Z,a,0,0,1\n1970-01-01T00:00:12+00:00,a,4,0,1\n1970-01-01T00:01:00,a,9,0,1\n"
        "1970-01-01T00:00:10Z,b,7,7,7\n"
    )
    truth = read_truth(written(tmp_path / "t.csv", text))
    found = truth.at("a", 10.5)
    assert found is not None
    assert found[0] == pytest.approx([1.0, 0.0, 1.0], abs=1e-12)
    assert truth.at("a", 30.0) is None  # between points that are too far apart
    assert truth.at("b", 10.0) is not None
    assert truth.at("b", 10.1) is None
    assert truth.at("c", 10.0) is None
    way_points = read_truth(tmp_path / "t.csv", longest_gap=np.inf)
    found = way_points.at("a", 36.0)
    assert found is not None
    assert found[0] == pytest.approx([6.5, 0.0, 1.0], abs=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x_m,y_m\n1,2\n", "no z_m"),
        ("x_m,y_m,z_m\n1,2,3\n", "timestamp, or start and end"),
        ("timestamp_s,x_m,y_m,z_m\n1,2,x,3\n", "line 2"),
        ("timestamp_s,x_m,y_m,z_m\n1,2,nan,3\n", "line 2"),
        ("start_s,end_s,x_m,y_m,z_m\n2,1,2,3,4\n", "ends before it begins"),
    ],
)
def test_what_is_no_truth(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ReportError, match=message):
        read_truth(written(tmp_path / "t.csv", text))


def scored() -> ScoredFixes:
    errors = np.arange(1.0, 101.0) / 100.0
    truth = np.tile([5.0, 5.0, 1.0], (100, 1))
    position = truth + np.column_stack([0.6 * errors, 0.8 * errors, np.zeros(100)])
    return ScoredFixes(
        position=position,
        truth=truth,
        radius=np.tile([0.505, 0.685, 0.955, np.nan], (100, 1)),
        status=np.array(["ok"] * 80 + ["ambiguous"] * 20),
        num_used=np.repeat([4, 3], 50),
        place=np.repeat(np.arange(20), 5),
    )


def test_figures_by_hand() -> None:
    document = score_document(scored())
    errors = document["all"]["horizontal_error_m"]
    assert errors["mean"]["value"] == pytest.approx(0.505)
    assert errors["p50"]["value"] == pytest.approx(0.505)
    assert errors["p90"]["value"] == pytest.approx(0.901)
    low, high = errors["mean"]["interval"]
    # Twenty places whose means scatter by 0.29 m: the mean is known to 0.065 m, 90 % are within 1.64 times that.
    assert high - low == pytest.approx(2 * 1.64 * 0.29 / np.sqrt(20), rel=0.15)
    assert low < 0.505 < high
    circles = document["all"]["circles"]
    assert {p: c["holds"] for p, c in circles.items()} == pytest.approx({"0.5": 0.5, "0.68": 0.68, "0.9": 0.95})
    assert document["by_status"]["ok"]["fixes"] == 80
    assert document["by_status"]["ambiguous"]["horizontal_error_m"]["mean"]["value"] == pytest.approx(0.905)
    assert document["by_measurements_used"]["3"]["horizontal_error_m"]["p50"]["value"] == pytest.approx(0.755)


def test_page_and_picture() -> None:
    picture = score_picture(scored(), "fixes <beside> truth")
    assert picture.startswith(b"\x89PNG")
    page = score_page(score_document(scored()), picture, "fixes <beside> truth")
    assert "fixes &lt;beside&gt; truth" in page
    assert "<td>status ambiguous</td><td>20</td><td>4</td><td>0.9" in page
    assert "3 measurements used" in page
