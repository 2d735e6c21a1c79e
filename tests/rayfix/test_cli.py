"""The command line: every command on the small table, and every mistake with its one line."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rayfix.cli import main, make_parser
from rayfix.console import print_fix
from rayfix.example.drop import EXAMPLE_POSITION
from rayfix.example.files import write_example
from rayfix_tables.table import Table


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Run a command; return its exit status and what it printed."""
    capsys.readouterr()
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:
        status = int(stop.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def changed_example(folder: Path, changes: dict[str, str]) -> Path:
    """Write the example with other texts in its site file, and return that."""
    site = write_example(folder)
    text = site.read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    site.write_text(text, encoding="utf-8")
    return site


def one_line(text: str) -> str:
    """Return the only line of a message."""
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    return lines[0]


def test_example_check_build_info_verify_locate(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, hall_table_path: Path
) -> None:
    status, out, err = run(capsys, "example", tmp_path / "hall")
    assert (status, err) == (0, "")
    assert {p.name for p in (tmp_path / "hall").iterdir()} == {"hall.glb", "site.toml", "report.json"}
    assert str(tmp_path / "hall" / "site.toml") in out

    status, out, err = run(capsys, "check", tmp_path / "hall" / "site.toml")
    assert (status, err) == (0, "")
    assert "8 x 18 x 2.5 m" in out
    assert "0 errors, 0 warnings" in out

    status, out, err = run(capsys, "info", hall_table_path, "--json")
    assert status == 0
    facts = json.loads(out)
    assert [station["id"] for station in facts["stations"]] == ["bs1", "bs2", "bs3", "bs4"]
    assert facts["table_id"] == Table.open(hall_table_path).table_id
    assert run(capsys, "info", hall_table_path)[0] == 0

    status, out, _ = run(capsys, "verify", hall_table_path)
    assert status == 0
    assert facts["table_id"] in out

    status, out, _ = run(capsys, "locate", hall_table_path, tmp_path / "hall" / "report.json", "--json")
    assert status == 0
    answer = json.loads(out)
    position = [answer["position"][axis] for axis in "xyz"]
    assert answer["status"] == "ok"
    # The report's noise alone, 1 deg and 0.5 m, moves the fix by some 0.2 m.
    assert np.linalg.norm(np.subtract(position, EXAMPLE_POSITION)) < 0.5
    status, out, _ = run(capsys, "locate", hall_table_path, tmp_path / "hall" / "report.json")
    assert status == 0
    assert re.match(r"ok: \(\d+\.\d\d, \d+\.\d\d, \d+\.\d\d\) m\n", out)


def test_errors_of_angles_are_for_lines_that_state_none(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, hall_table_path: Path
) -> None:
    report = tmp_path / "report.json"
    report.write_text("{}", encoding="utf-8")
    status, out, err = run(capsys, "locate", hall_table_path, report, "--stdev", "3")
    assert (status, out) == (2, "")
    assert "--stdev and --tails are for u-blox lines" in one_line(err)
    status, out, err = run(capsys, "locate", hall_table_path, report, "--format", "ublox", "--stdev", "0")
    assert (status, out) == (2, "")
    assert "stdev_deg" in one_line(err)


def test_locate_takes_and_gives_other_formats(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, hall_table_path: Path
) -> None:
    lines = tmp_path / "lines.txt"
    angles = {"A1": (15, -6), "A2": (33, -13), "A3": (-42, -3), "A4": (19, -3)}
    lines.write_text(
        "".join(
            f'+UUDF:TAG{n},-53,{azimuth},{elevation},0,37,"{anchor}","",1437347,7\n'
            for n in (1, 2)
            for anchor, (azimuth, elevation) in angles.items()
        ),
        encoding="utf-8",
    )
    stations = [word for n in (1, 2, 3, 4) for word in ("--station", f"A{n}=bs{n}")]
    errors = ("--stdev", "3", "--tails", "0", "1")
    command = ("locate", hall_table_path, lines, "--format", "ublox", *stations, *errors)
    status, out, err = run(capsys, *command, "--output", "omlox")
    assert (status, err) == (0, "")
    locations = [json.loads(line) for line in out.splitlines()]
    assert [location["provider_id"] for location in locations] == ["TAG1", "TAG2"]
    # The target stands there; anchors of 3 deg tell its height from 8 m to 0.4 m each.
    for location in locations:
        assert np.linalg.norm(np.subtract(location["position"]["coordinates"], [7.0, 4.0, 1.5])) < 0.7
    status, out, err = run(capsys, *command)
    assert (status, err) == (0, "")
    assert out.startswith("TAG1:\n")
    assert "TAG2:\n" in out

    status, out, err = run(capsys, *command, "--json", "--height", "1.5", "0.01")
    assert (status, err) == (0, "")
    for line in out.splitlines():
        assert json.loads(line)["position"]["z"] == pytest.approx(1.5, abs=0.03)
    status, _, err = run(capsys, *command, "--height", "1.5", "-1")
    assert status == 2
    assert "height is 1.5 m with a standard deviation of -1.0 m; give both numbers" in one_line(err)

    status, _, err = run(capsys, *command[:5])
    assert status == 2
    assert "lines.txt: lines[0]: station 'A1' is not in the table" in one_line(err)
    assert "give the station in the map stations" in err
    status, _, err = run(capsys, *command, "--station", "A1")
    assert status == 2
    assert "station 'A1' is not a pair; give NAME=STATION" in one_line(err)


@pytest.mark.parametrize(
    ("arguments", "scene"), [(["office"], "office"), (["hall", "office"], "hall"), (["desks"], "hall")]
)
def test_an_example_is_the_one_that_is_named(
    arguments: list[str],
    scene: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`rayfix example office` wrote the hall into a folder 'office'."""
    monkeypatch.chdir(tmp_path)
    status, out, _ = run(capsys, "example", *arguments)
    assert status == 0
    folder = tmp_path / arguments[-1]
    assert {path.stem for path in folder.iterdir()} == {scene, "site", "report"}
    assert f"{scene}.h5" in out


def test_a_scene_is_no_site_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    scene = tmp_path / "room.obj"
    scene.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="utf-8")
    status, _, err = run(capsys, "check", scene)
    assert status == 2
    assert 'scene = "room.obj"' in one_line(err)


def test_the_example_spares_what_is_there(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(capsys, "example", tmp_path)[0] == 0
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert run(capsys, "example", tmp_path)[0] == 0  # the same again
    site = tmp_path / "site.toml"
    site.write_text("# days of work", encoding="utf-8")
    (tmp_path / "report.json").unlink()
    status, out, err = run(capsys, "example", tmp_path)
    assert (status, out) == (2, "")
    assert "site.toml exists and is not from the example; choose another folder" in one_line(err)
    assert site.read_text(encoding="utf-8") == "# days of work"
    assert not (tmp_path / "report.json").exists()
    assert (tmp_path / "hall.glb").read_bytes() == files["hall.glb"]


def test_a_mistake_in_the_site_is_one_line_beside_a_progress_bar(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    status, out, err = run(capsys, "build", tmp_path / "none.toml", "-o", tmp_path / "t.h5")
    assert (status, out) == (2, "")
    (line,) = err.splitlines()
    assert "there is no site file" in line


def test_an_updated_table_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Closing gaps by a hair: nothing visible changes, but the scene is another one."""
    site = changed_example(tmp_path, {"[1.25, 5, 15]": "[15.0]", "max_reflections = 3": "max_reflections = 1"})
    table = tmp_path / "t.h5"
    assert run(capsys, "build", site, "-o", table, "--no-progress")[0] == 0
    text = site.read_text(encoding="utf-8")
    site.write_text(text.replace("reflection_loss_db = 6.0", "reflection_loss_db = 6.01"), encoding="utf-8")
    status, out, err = run(capsys, "build", site, "-o", table, "--tolerance", "0.05", "--no-progress")
    assert (status, err) == (0, "")
    assert re.search(r"bs1: \d+ of \d+ finest cells kept, changed by at most \d\.\d\d%", out)
    out = run(capsys, "info", table)[1]
    assert re.search(r"bs1: [\d,]+ of [\d,]+ cells differ from those of a new build, by at most \d\.\d\d% ", out)
    assert "(tolerance 5.00%); build without --tolerance to make it exact" in out
    facts = json.loads(run(capsys, "info", table, "--json")[1])
    for station in facts["stations"]:
        assert 0.0 < station["update"]["largest_change"] <= station["update"]["tolerance"] == 0.05
        assert station["update"]["changed_cells"] > 0
    summary = json.loads(run(capsys, "build", site, "-o", table, "--no-progress", "--json")[1])
    assert all(station["largest_change"] == 0.0 for station in summary["stations"])
    facts = json.loads(run(capsys, "info", table, "--json")[1])
    assert all(station["update"] is None for station in facts["stations"])


@pytest.mark.parametrize("share", ["2", "-0.1", "nan", "much"])
def test_a_tolerance_that_is_no_share(capsys: pytest.CaptureFixture[str], tmp_path: Path, share: str) -> None:
    status, _, err = run(capsys, "build", "site.toml", "-o", tmp_path / "t.h5", f"--tolerance={share}")
    assert status == 2
    assert "--tolerance" in one_line(err)


def test_build_writes_a_table_and_a_summary(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    site = changed_example(tmp_path, {"[1.25, 5, 15]": "[10.0]", "max_reflections = 3": "max_reflections = 1"})
    status, out, err = run(capsys, "build", site, "-o", tmp_path / "t.h5", "--no-progress")
    assert (status, err) == (0, "")
    assert Table.open(tmp_path / "t.h5").table_id in out
    assert out.count("bs") == 4


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["info", "{tmp}/none.h5"], r"there is no table at .*none\.h5; build one with 'rayfix build"),
        (["verify", "{tmp}"], r"is not a rayfix table"),
        (["build", "{site}", "-o", "{site}"], r"site\.toml: the file there is not a table; give another name"),
        (["build", "{tmp}/none.toml", "-o", "{tmp}/t.h5"], r"there is no site file at .*none\.toml"),
        (["check", "{tmp}/none.toml"], r"there is no site file at .*none\.toml"),
        (["build", "{site}", "-o", "{tmp}/no/such/t.h5"], r"there is no folder .*no/such; create it first"),
        (["build", "{site}", "-o", "{tmp}/t.h5", "--jobs", "0"], r"--jobs: '0' is not a valid number of jobs"),
        (
            ["build", "{site}", "-o", "{tmp}/t.h5", "--jobs", "many"],
            r"--jobs: 'many' is not a valid number of jobs; give 1",
        ),
        (
            ["serve", "{table}", "--root-path", "/a/../b"],
            r"'/a/\.\./b' is not a plain path; give e.g\. /rayfix",
        ),
        (["locate", "{table}", "{tmp}/none.json"], r"none\.json cannot be read"),
        (["locate", "{table}", "{site}", "--station", "A=bs1"], r"--station is for other systems' messages"),
        (
            ["locate", "{table}", "{site}", "--format", "nrppa", "--station", "7=bs9"],
            r"7 is mapped to station 'bs9', which is",
        ),
        (["mqtt", "{table}", "--broker", "localhost:1", "--station", "A=bs9"], r"is not in the table; it has bs1, bs2"),
        (
            ["plan", "{table}", "-o", "{tmp}/m.png", "--height", "1", "--seed", "-1"],
            r"--seed: '-1' is not a valid seed; give",
        ),
        (["plot", "{table}", "{site}", "-o", "{tmp}/p.png", "--seed", "x"], r"--seed: 'x' is not a valid seed; give"),
        (
            ["plot", "{table}", "{site}", "-o", "{tmp}/p.png", "--layers", ","],
            r"',' names no layer; give one or more of rays",
        ),
        (["plot", "{table}", "{site}", "-o", "{tmp}/p.png", "--truth", "1", "nan", "1"], r"'nan' is not a coordinate"),
        (
            ["plot", "{table}", "{site}", "-o", "{tmp}/p"],
            r"p is not a valid name of a picture; end it in \.png, \.svg or \.pdf",
        ),
        (["plot", "{table}", "{site}", "-o", "{tmp}/no/p.png"], r"there is no folder .*no; create it first"),
        (["view", "{table}", "{site}", "-o", "{site}"], r"site\.toml is not a valid name of a page; end it in \.html"),
        (["serve", "{tmp}/none.h5", "--port", "0"], r"there is no table at"),
        (["serve", "{table}", "--cors-origin", "maps.example.com"], r"is not an origin; give scheme, host and port"),
        (["serve", "{table}", "--cors-origin", "https://a.example/x"], r"is not an origin; give scheme, host and port"),
        (["serve", "{table}", "--workers", "0"], r"workers is 0; give at least 1"),
        (
            ["plan", "{table}", "-o", "{tmp}/m.png", "--height", "1", "--azimuth-stdev-deg", "-1"],
            r"--azimuth-stdev-deg: '-1'",
        ),
        (["build", "{site}", "-o", "{tmp}/t.txt"], r"t\.txt is not a valid name of a table; end it in \.h5"),
        (
            ["calibrate", "{table}", "{site}", "-o", "{site}"],
            r"was not written by rayfix calibrate; give the name of a",
        ),
        (
            ["plan", "{table}", "-o", "{tmp}/m.png", "--height", "1", "--draws", "0"],
            r"--draws: '0' is not an integer of 1",
        ),
        (["frobnicate"], r"invalid choice: 'frobnicate'"),
        ([], r"required: COMMAND"),
        (["build", "{site}"], r"required: -o/--output"),
    ],
)
def test_mistakes_are_one_line_and_status_2(
    arguments: list[str],
    expected: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    hall_site_path: Path,
    hall_table_path: Path,
) -> None:
    places = {"tmp": str(tmp_path), "site": str(hall_site_path), "table": str(hall_table_path)}
    status, out, err = run(capsys, *(a.format(**places) for a in arguments))
    assert (status, out) == (2, "")
    assert re.search(expected, one_line(err))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("", r"report\.json: .*JSON"),
        ('{"measurements": []}', r"report\.json: .*measurements"),
        (
            '{"measurements": [{"type": "pt", "station_id": "bs9", "range_m": 5, "stdev_m": 1}]}',
            r"report\.json: .*'bs9'.*bs1",
        ),
        (
            2 * '{"measurements": [{"type": "pt", "station_id": "bs1", "range_m": 5, "stdev_m": 1}]}\n',
            r"report\.json holds more than one report; add -o FIXES\.jsonl",
        ),
    ],
)
def test_locate_names_what_is_wrong_with_a_report(
    body: str, expected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, hall_table_path: Path
) -> None:
    report = tmp_path / "report.json"
    report.write_text(body, encoding="utf-8")
    status, _, err = run(capsys, "locate", hall_table_path, report)
    assert status == 2
    assert re.search(expected, one_line(err))


def test_check_lists_all_problems_at_once(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    site = changed_example(tmp_path, {"[0.1, 0.1, 2.4]": "[1.9, 1.9, 1.0]", "[7.9, 0.1, 2.4]": "[9.0, 0.1, 2.4]"})
    status, out, _ = run(capsys, "check", site)
    assert status == 2
    assert "error: station 'bs1' at (1.9, 1.9, 1) m lies inside the solid 'machine_1'; move it into free space" in out
    assert "error: station 'bs2' at (9, 0.1, 2.4) m lies outside the scene" in out
    assert "2 errors" in out
    status, _, err = run(capsys, "build", site, "-o", tmp_path / "t.h5", "--no-progress")
    assert status == 2
    assert "machine_1" in one_line(err)
    assert "bs2" in err
    assert not (tmp_path / "t.h5").exists()


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Children of a process that ignores SIGINT, as shells start it in the background, would ignore it too."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_build_leaves_the_former_table(tmp_path: Path, hall_table_path: Path) -> None:
    main(["example", str(tmp_path / "site")])
    table = Path(shutil.copy(hall_table_path, tmp_path / "t.h5"))
    before = table.read_bytes()
    arguments = ["build", str(tmp_path / "site" / "site.toml"), "-o", str(table), "--no-progress"]
    with subprocess.Popen([sys.executable, "-m", "rayfix", *arguments], stderr=subprocess.PIPE, text=True) as build:
        deadline = time.monotonic() + 120.0
        while not list(tmp_path.glob(".t.h5.shards/*")) and build.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        build.send_signal(signal.SIGINT)
        _, stderr = build.communicate(timeout=100)
    assert build.returncode == 130, stderr
    said = [line for line in stderr.splitlines() if "compiling kernels" not in line]
    interrupted = "rayfix: interrupted; finished work is kept, run the same command again to go on"
    assert one_line("\n".join(said)) == interrupted
    assert table.read_bytes() == before
    # What is finished waits in its folder for the next run; nothing else is there.
    assert {p.name for p in tmp_path.iterdir()} == {".t.h5.shards", "site", "t.h5"}


def test_an_inconsistent_fix_is_shown_without_probabilities(capsys: pytest.CaptureFixture[str]) -> None:
    place = {"x": 1.0, "y": 2.0, "z": 3.0}
    print_fix(
        {
            "status": "inconsistent",
            "position": place,
            "candidates": [{"probability": 0.996, "position": place}],
            "horizontal_accuracy_m": 0.2,
            "vertical_accuracy_m": 0.2,
            "confidence": 0.68,
            "measurements": [{"index": 0, "used": True, "outlier_probability": 0.97}],
            "warnings": ["probably outliers are the angle of station 'bs1' (measurements[0])"],
        }
    )
    out = capsys.readouterr().out
    assert out.splitlines()[0] == "inconsistent: (1.00, 2.00, 3.00) m is only the best guess"
    assert "the angle of station 'bs1'" in out
    assert "%" not in out


@pytest.mark.parametrize(("given", "prefix"), [([], None), (["--root-path", "/"], ""), (["--root-path", "/a/"], "/a")])
def test_a_service_needs_no_prefix(given: list[str], prefix: str | None) -> None:
    assert make_parser().parse_args(["serve", "T.h5", *given]).root_path == prefix
