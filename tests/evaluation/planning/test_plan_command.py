"""``rayfix plan``."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from rayfix.cli import main


def test_a_map_is_drawn_and_told(capsys: pytest.CaptureFixture[str], screen_path: Path, tmp_path: Path) -> None:
    picture = tmp_path / "map.png"
    command = ["plan", str(screen_path), "--height", "1.1", "-o", str(picture), "--draws", "1", "--no-progress"]
    assert main([*command, "--times", "pt", "--range-stdev-m", "0.3", "--azimuth-stdev-deg", "2", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert document["site"] == "room"
    assert document["settings"]["zenith_stdev_deg"] == pytest.approx(2.0, rel=1e-12)
    assert document["settings"]["range_stdev_m"] == 0.3
    squares = document["map"]
    assert len(squares) == document["squares"]
    assert np.mean([square["within_threshold"] for square in squares]) == pytest.approx(document["coverage"])
    assert set(squares[0]["heard"]) == {"a", "b", "c"}

    assert main(command) == 0
    out, err = capsys.readouterr()
    assert out.startswith("abc.h5: ")
    assert "audible stations" in out
    assert err == ""


def test_two_tables_are_compared(
    capsys: pytest.CaptureFixture[str], screen_path: Path, fewer_path: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "map.svg"
    command = ["plan", str(fewer_path), "--beside", str(screen_path), "--height", "1.1", "-o", str(picture)]
    assert main([*command, "--draws", "1", "--spacing-m", "1", "--threshold-m", "0.3"]) == 0
    out, err = capsys.readouterr()
    first, second, change = out.splitlines()
    assert first.startswith("ab.h5: ")
    assert second.startswith("abc.h5: ")
    assert float(change.split()[1]) > 5.0  # a station more
    assert "positions of abc.h5" in err
    assert "change of the error" in picture.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--height", "9"], "nothing is free at a height of 9.0 m"),
        (["--height", "1", "--spacing-m", "50"], "squares of 50 m do not fit into the building of"),
    ],
)
def test_mistakes_are_one_line(
    capsys: pytest.CaptureFixture[str], screen_path: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    assert main(["plan", str(screen_path), "-o", str(tmp_path / "map.png"), "--no-progress", *arguments]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1


def test_a_map_that_is_no_picture_is_refused(
    capsys: pytest.CaptureFixture[str], screen_path: Path, tmp_path: Path
) -> None:
    assert main(["plan", str(screen_path), "-o", str(tmp_path / "map.txt"), "--height", "1"]) == 2
    assert "map.txt is not a valid name of a picture; end it in .png, .svg or .pdf" in capsys.readouterr().err


def test_the_place_of_the_picture_is_checked_before_the_work(
    capsys: pytest.CaptureFixture[str], screen_path: Path, tmp_path: Path
) -> None:
    assert main(["plan", str(screen_path), "-o", str(tmp_path / "no" / "map.png"), "--height", "1"]) == 2
    (line,) = capsys.readouterr().err.splitlines()  # and no bar
    assert re.search(r"there is no folder .*no; create it first", line)
