"""From a log to a calibrated site file, its table, and better fixes; and deviations without the truth."""

import json
from pathlib import Path

import numpy as np
import pytest

from rayfix.cli import main
from rayfix_offline.build import build_table
from rayfix_tables.table import Table

pytestmark = pytest.mark.slow

SITE = """
[site]
name = "lab"
[room]
size_m = [8.0, 6.0, 3.0]
[propagation]
max_reflections = 0
max_path_length_m = 20.0
[table]
windows_deg = [5.0]
"""
STATIONS = {"a": (0.1, 0.1, 2.8), "b": (7.9, 0.1, 2.8), "c": (0.1, 5.9, 2.8), "d": (7.9, 5.9, 2.8)}
BIAS_DEG = {"a": 3.0, "b": -3.0, "c": 2.0, "d": 0.0}


def write_log(folder: Path, seed: int, *, biased: bool) -> tuple[Path, Path]:
    """Write a log of 40 places and the truth; azimuths scatter by 2 deg, which is stated as 1 deg."""
    rng = np.random.default_rng(seed)
    lines, truth = [], ["start_s,end_s,x_m,y_m,z_m"]
    for place in range(40):
        x, y, z = rng.uniform([0.5, 0.5, 0.5], [7.5, 5.5, 1.8])
        begin = 1_700_000_000 + 100 * place
        truth.append(f"{begin},{begin + 50},{x},{y},{z}")
        for n in range(5):
            measurements = []
            for name, position in STATIONS.items():
                apart = np.array([x, y, z]) - position
                azimuth = np.degrees(np.arctan2(apart[1], apart[0])) + 2.0 * rng.normal()
                zenith = np.degrees(np.arccos(apart[2] / np.linalg.norm(apart))) + 2.0 * rng.normal()
                measurements.append(
                    {
                        "type": "aoa",
                        "station_id": name,
                        "azimuth_deg": azimuth + (BIAS_DEG[name] if biased else 0.0),
                        "azimuth_stdev_deg": 1.0,
                        "zenith_deg": zenith,
                        "zenith_stdev_deg": 1.0,
                    }
                )
            stamp = np.datetime64(begin + n, "s").item().isoformat() + "Z"
            lines.append(json.dumps({"target_id": "t", "timestamp": stamp, "measurements": measurements}))
    log, true = folder / f"log{seed}.jsonl", folder / f"truth{seed}.csv"
    log.write_text("\n".join(lines), encoding="utf-8")
    true.write_text("\n".join(truth), encoding="utf-8")
    return log, true


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lab")
    stations = "".join(f'[[stations]]\nid = "{n}"\nposition_m = {list(p)}\n' for n, p in STATIONS.items())
    (path / "site.toml").write_text(SITE + stations, encoding="utf-8")
    build_table(path / "site.toml", path / "lab.h5", jobs=1)
    return path


def mean_error(table: Path, log: Path, truth: Path, capsys: pytest.CaptureFixture[str]) -> tuple[float, float]:
    fixes = table.with_name(f"{table.stem}-{log.stem}.jsonl")
    assert main(["locate", str(table), str(log), "-o", str(fixes), "--jobs", "1", "--no-progress"]) == 0
    capsys.readouterr()
    assert main(["score", str(fixes), str(truth), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["all"]
    return found["horizontal_error_m"]["mean"]["value"], found["circles"]["0.68"]["holds"]


def test_a_calibrated_site_locates_better(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, truth = write_log(folder, 1, biased=True)
    other, other_truth = write_log(folder, 2, biased=True)
    site = folder / "site.calibrated.toml"
    command = ["calibrate", str(folder / "lab.h5"), str(log), "--truth", str(truth), "-o", str(site)]
    assert main([*command, "--no-progress", "--json", "--pictures", str(folder / "pictures")]) == 0
    found = json.loads(capsys.readouterr().out)
    for name, bias in BIAS_DEG.items():
        angles = found["stations"][name]["angles"]
        assert angles["bias_deg"][0] == pytest.approx(bias, abs=0.7)
        assert angles["stdev_deg"] == pytest.approx([2.0, 2.0], rel=0.15)
    evidence = found["log_evidence_per_report"]
    assert evidence["after"] > evidence["before"]
    held_out = found["held_out"]
    assert (held_out["taken"], held_out["reports"]) == ("all", 200)
    by_part = held_out["log_evidence_per_report"]
    assert by_part["all"] > max(by_part["systematic"], by_part["deviations"]) > by_part["nothing"]
    assert (folder / "pictures" / "a.png").stat().st_size > 1000
    build_table(site, folder / "calibrated.h5", jobs=1, former=folder / "lab.h5")
    assert Table.open(folder / "calibrated.h5").site.has_deviations
    before, _ = mean_error(folder / "lab.h5", other, other_truth, capsys)
    after, held = mean_error(folder / "calibrated.h5", other, other_truth, capsys)
    assert after < 0.8 * before
    assert 0.5 < held < 0.85


def test_errors_that_differ_from_place_to_place_are_no_bias(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Thirty reports of a place repeat its error: taken for thirty errors, they told tails that were not there."""
    rng = np.random.default_rng(5)
    lines, truth = [], ["timestamp_s,x_m,y_m,z_m"]
    for place in range(7):
        x, y, z = rng.uniform([0.5, 0.5, 0.5], [7.5, 5.5, 1.8])
        off = {name: 0.3 * rng.standard_t(2) for name in STATIONS}
        for n in range(30):
            seconds = 1_700_000_000 + 100 * place + n
            measurements = [
                {
                    "type": "pt",
                    "station_id": name,
                    "range_m": float(np.linalg.norm(np.array([x, y, z]) - position)) + off[name] + 0.02 * rng.normal(),
                    "stdev_m": 0.6,
                }
                for name, position in STATIONS.items()
            ]
            stamp = np.datetime64(seconds, "s").item().isoformat() + "Z"
            lines.append(json.dumps({"target_id": "t", "timestamp": stamp, "measurements": measurements}))
            truth.append(f"{seconds},{x},{y},{z}")
    log, true, site = (folder / name for name in ("few.jsonl", "few.csv", "few.toml"))
    log.write_text("\n".join(lines), encoding="utf-8")
    true.write_text("\n".join(truth), encoding="utf-8")
    command = ["calibrate", str(folder / "lab.h5"), str(log), "--truth", str(true), "-o", str(site)]
    assert main([*command, "--no-progress", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {station["places"] for station in found["stations"].values()} == {7}
    for station in found["stations"].values():
        assert station["ranges"]["stdev_m"] > 0.1  # seven errors, and not two hundred that scatter by 0.02 m
    held_out = found["held_out"]
    evidence = held_out["log_evidence_per_report"]
    assert evidence[held_out["taken"]] == max(evidence.values())


def test_deviations_without_the_truth(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, _ = write_log(folder, 3, biased=False)
    site = folder / "site.deviations.toml"
    assert main(["calibrate", str(folder / "lab.h5"), str(log), "-o", str(site), "--no-progress", "--json"]) == 0
    stations = json.loads(capsys.readouterr().out)["stations"]
    assert list(stations) == list(STATIONS)
    for each in stations.values():
        # They are stated as 1 deg and drawn with 2 deg.
        assert each["angles"]["stdev_deg"] == pytest.approx([2.0, 2.0], rel=0.25)
        assert each["notes"] == ["biases and turns need true positions: give --truth"]


def test_times_that_do_not_fit_are_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, _ = write_log(folder, 4, biased=False)
    truth = folder / "later.csv"
    truth.write_text("start_s,end_s,x_m,y_m,z_m\n1,2,3,4,1\n", encoding="utf-8")
    command = ["calibrate", str(folder / "lab.h5"), str(log), "--truth", str(truth), "-o", str(folder / "x.toml")]
    assert main([*command, "--no-progress"]) == 2
    assert "check the times of both" in capsys.readouterr().err
