"""The whole command on a small room."""

import csv
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from rayfix.cli import main
from rayfix_evaluation.report.tables import COLUMNS, study_rows

PAPER_FIGURES = {
    "scene",
    "plane-points",
    "points-aoa",
    "mixture-aoa",
    "points-aoa-pt",
    "mixture-aoa-pt",
    "length-differences",
    "cdf-aoa",
    "cdf-pt",
    "cdf-rpt",
}


@pytest.fixture(scope="module")
def evaluated(room_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder of an evaluation of two drops, by two processes."""
    folder = tmp_path_factory.mktemp("evaluated")
    arguments = ["evaluate", str(room_site), "-o", str(folder), "--quick", "--drops", "2", "--seed", "5", "--jobs", "2"]
    assert main([*arguments, "--no-progress"]) == 0
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_what_is_missing_is_done_again_and_gives_the_same(
    evaluated: Path, room_site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tenth of the finished runs is lost; one process does them again and leaves the others as they are."""
    again = tmp_path / "again"
    shutil.copytree(evaluated, again)
    stored = sorted((again / "work" / "results").glob("*.json"))
    lost, kept = stored[::10], [path for n, path in enumerate(stored) if n % 10]
    before = {path: path.stat().st_mtime_ns for path in kept}
    lost[0].write_text("{", encoding="utf-8")  # not whole
    for path in lost[1:]:
        path.unlink()
    (again / "results.json").unlink()
    arguments = ["evaluate", str(room_site), "-o", str(again), "--quick", "--drops", "2", "--seed", "5", "--jobs", "1"]
    assert main([*arguments, "--no-progress"]) == 0
    assert (again / "results.json").read_bytes() == (evaluated / "results.json").read_bytes()
    assert {path: path.stat().st_mtime_ns for path in kept} == before
    assert all(path.exists() for path in lost)
    assert "report.html" in capsys.readouterr().out


@pytest.mark.slow
def test_tables_hold_what_the_results_do(evaluated: Path) -> None:
    results = json.loads((evaluated / "results.json").read_text(encoding="utf-8"))
    assert {"seed", "table_id", "software_version", "libraries", "code"} <= results.keys()
    assert len(results["studies"]) >= 15
    for study in results["studies"]:
        text = (evaluated / "tables" / f"{study['key']}.csv").read_text(encoding="utf-8")
        first, rest = text.split("\n", 1)
        assert results["table_id"] in first
        rows = list(csv.DictReader(rest.splitlines()))
        wanted = [{c: "" if v is None else str(v) for c, v in row.items()} for row in study_rows(study)]
        assert rows == wanted
        assert list(rows[0]) == list(COLUMNS)


@pytest.mark.slow
def test_every_figure_is_there_and_the_page_needs_nothing_else(evaluated: Path) -> None:
    page = (evaluated / "report.html").read_text(encoding="utf-8")
    drawn = {path.stem for path in (evaluated / "figures").glob("*.svg")}
    assert drawn == {path.stem for path in (evaluated / "figures").glob("*.png")}
    assert drawn >= PAPER_FIGURES
    assert {"methods-cdf", "methods-percentiles", "calibration", "planning", "antenna-arrays"} <= drawn
    for key in drawn:
        assert f'<figure id="{key}">' in page
    for key in PAPER_FIGURES & {"scene", "points-aoa", "mixture-aoa", "points-aoa-pt", "mixture-aoa-pt"}:
        json.loads(re.findall(rf'<script type="application/json" id="data-{key}">(.*?)</script>', page)[0])
    # Nothing is loaded: neither scripts nor styles nor pictures have an address.
    own = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', own) == []
    assert page.count("plotly.js v") == 1
    for target in re.findall(r'href="#([^"]+)"', page):
        assert f'id="{target}"' in page


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("max_reflections = 2", "propagation.max_reflections is 2 in the site and 1 in the table"),
        ("reflection_loss_db = 3.0\nmax_reflections = 1", "propagation.reflection_loss_db is 3.0"),
    ],
)
def test_a_table_of_another_site_is_refused(
    evaluated: Path, room_site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str, said: str
) -> None:
    site = tmp_path / "site.toml"
    site.write_text(room_site.read_text(encoding="utf-8").replace("max_reflections = 1", change), encoding="utf-8")
    table = evaluated / "work" / "tables" / "site.h5"
    assert main(["evaluate", str(site), "-o", str(tmp_path / "out"), "--table", str(table), "--no-progress"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--seed", "-1"], ["--drops", "1"], ["--jobs", "0"], []])
def test_mistakes_are_one_line(
    room_site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    site = room_site if arguments else tmp_path / "none.toml"
    try:
        status = main(["evaluate", str(site), "-o", str(tmp_path / "out"), "--no-progress", *arguments])
    except SystemExit as stopped:
        status = int(str(stopped.code))
    assert status == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_folder_that_cannot_be_is_said(room_site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert main(["evaluate", str(room_site), "-o", str(tmp_path / "file" / "out"), "--no-progress"]) == 2
    error = capsys.readouterr().err
    assert "choose another folder" in error
    assert error.count("\n") == 1
