"""The benchmarks of fixes run on a small table and print a figure for each case."""

import runpy
import shutil
from pathlib import Path

import pytest

from tests.support.checkout import ROOT

BENCHMARKS = ROOT / "benchmarks"


def run(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> list[str]:
    """Lines that a benchmark prints."""
    monkeypatch.setattr("sys.argv", [name, *arguments])
    runpy.run_path(str(BENCHMARKS / name), run_name="__main__")
    return capsys.readouterr().out.splitlines()


@pytest.mark.slow
def test_calibration(
    hall_table_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["--table", str(hall_table_path), "--drops", "8", "--select", "random"]
    lines = run("fusion/calibration.py", capsys, monkeypatch, *arguments)
    rows = [line.split() for line in lines[3:]]
    assert [(row[1], float(row[0])) for row in rows] == [
        (timing, deviation) for timing in ("none", "pt", "tdoa") for deviation in (0.25, 1.0, 5.0)
    ]
    # The shares of the four ellipsoids grow with their probability.
    for row in rows:
        shares = [float(row[2 + 3 * n]) for n in range(4)]
        assert shares == sorted(shares)
        assert 0.0 <= shares[0] <= shares[-1] <= 100.0


@pytest.mark.slow
def test_stress(hall_table_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    lines = run("fusion/stress.py", capsys, monkeypatch, "--table", str(hall_table_path), "--drops", "12")
    assert [line[:28].strip() for line in lines if line.startswith(("random", "PT +", "ToA +"))] == [
        "random angle, no times",
        "random angle, PT",
        "PT + 10 m",
        "ToA + 10 m",
    ]
    buildings = [line for line in lines if ", angles" in line]
    assert len(buildings) == 10
    for line in buildings:
        median, most = (float(value) for value in line[41:].split()[:2])
        assert 0.0 < median <= most


@pytest.mark.slow
def test_fusion(hall_table_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--table", str(hall_table_path), "--reports", "3", "--paper-reports", "1"]
    lines = run("fusion/fix_time.py", capsys, monkeypatch, *arguments)
    rows = lines[3:]
    assert [row[:12].strip() for row in rows] == ["AoA + PT", "AoA + ToA", "AoA + TDoA", "AoA", "PT", "TDoA"]
    for row in rows:
        ours, _, error, _, theirs = (float(value) for value in row[12:].split()[:5])
        assert min(ours, theirs, error) > 0.0


@pytest.mark.slow
def test_exhaustive(hall_table_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--table", str(hall_table_path), "--reports", "33", "--products", "500"]
    rows = [line.rsplit(maxsplit=9) for line in run("fusion/exhaustive.py", capsys, monkeypatch, *arguments)[4:]]
    assert len({label for label, *_ in rows}) == len(rows) == 11
    for _, *figures in rows:
        for half, most in zip(figures[::3], figures[2::3], strict=True):
            assert 0.0 <= float(half) <= float(most)
        assert float(figures[0]) < 0.05


@pytest.mark.slow
def test_uwb(
    shared_data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    picture = tmp_path / "uwb.png"
    # The default beam loses fixes from ranges alone when one of them is wrong.
    arguments = ["--data", str(shared_data / "uwb"), "--reports", "3", "--windows", "15", "--beam", "1024"]
    arguments += ["--plot", str(picture)]
    lines = run("recorded/uwb.py", capsys, monkeypatch, *arguments)
    rows = {line[:39].strip(): [float(v) for v in line[39:].split()[:6]] for line in lines[3:]}
    assert list(rows) == [
        "least squares",
        "least squares, one wrong",
        "same, height known",
        "same, height known, one wrong",
        "rayfix 15 deg",
        "rayfix 15 deg, one wrong",
        "rayfix 15 deg, height known",
        "rayfix 15 deg, height known, one wrong",
    ]
    # Median horizontal errors of nine fixes; one range of eight is 3 m too long.
    assert rows["rayfix 15 deg, one wrong"][0] < 0.5 * rows["least squares, one wrong"][0]
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
def test_tracking(hall_table_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--table", str(hall_table_path), "--walks", "2", "--reports", "12"]
    lines = run("fusion/tracking.py", capsys, monkeypatch, *arguments)
    rows = lines[3:]
    assert len(rows) == 14
    for fix, track in zip(rows[::2], rows[1::2], strict=True):
        assert "fix" in fix
        assert "track" in track
        rms, half, most = (float(value) for value in track.split("track")[1].split()[:3])
        assert 0.0 < half <= most
        assert half <= 2.0 * rms
    # With the coarse table and no times, the tracks of all stations' reports are better than the fixes by far.
    first = [float(line.split(kind)[1].split()[0]) for line, kind in zip(rows, ("fix", "track"), strict=False)]
    assert first[1] < 0.6 * first[0]


@pytest.mark.slow
def test_mqtt(hall_table_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin") is None:
        pytest.skip("the MQTT broker mosquitto is not installed (Debian: apt-get install mosquitto)")
    arguments = ["--table", str(hall_table_path), "--seconds", "1.5", "--track"]
    sent, received, *latencies, _ = run("service/mqtt.py", capsys, monkeypatch, *arguments)
    assert sent.startswith("1 tags at 40 Hz:")
    assert " 60 packets in " in sent
    assert received == "60 positions, 0 packets without"
    assert latencies
