"""The log evidence of reports tells which of two tables is right, and says so when it does not."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from rayfix.cli import main
from rayfix_evaluation.recorded.comparison import compare_tables, standard_error
from rayfix_offline.build import build_table
from rayfix_service.fusion.measurements.report import Angle, Report
from rayfix_service.locator import Locator
from rayfix_tables.errors import ReportError
from rayfix_tables.table import Table
from tests.support.scenes.shapes import box, quad

SITE = """
[site]
name = "flat"
scene = "flat.obj"
scene_up = "z"
[propagation]
carrier_ghz = 3.5
max_reflections = 0
max_path_length_m = 20.0
transmission = {transmission}
[materials.wood]
thickness_m = 0.04
[table]
windows_deg = [5.0]
"""
STATIONS = {"a": (0.2, 0.2, 2.8), "b": (0.2, 5.8, 2.8), "c": (7.8, 3.1, 2.8)}
PLACES = {"before": (0.5, 3.5), "behind": (4.5, 7.5)}
"""Where along x the targets are: before the wooden wall, seen from a and b, or behind it."""


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build tables of a room of 8 x 6 x 3 m with a wooden wall across it at x = 4 m, passed or taken for opaque.

    ::

        +-----+-----+
        | b   |     |
        |     |   c |    the wall is 2.8 m long: around its end, at y > 2.8 m, the ways are free
        | a   #     |
        +-----#-----+
    """
    folder = tmp_path_factory.mktemp("flat")
    lines, count = [], 0
    room, wall = box((0, 0, 0), (8, 6, 3)), quad((4, 0, 0), (4, 2.8, 0), (4, 2.8, 3), (4, 0, 3))
    for material, triangles in (("metal", room), ("wood", wall)):
        corners = np.asarray(triangles).reshape(-1, 3)
        lines += [f"o {material}", *(f"v {x} {y} {z}" for x, y, z in corners), f"usemtl itu_{material}"]
        lines += [f"f {n + 1} {n + 2} {n + 3}" for n in range(count, count + len(corners), 3)]
        count += len(corners)
    (folder / "flat.obj").write_text("\n".join(lines), encoding="utf-8")
    stations = "".join(f'[[stations]]\nid = "{n}"\nposition_m = {list(p)}\n' for n, p in STATIONS.items())
    for name, transmission in (("opaque", "false"), ("passed", "true")):
        site = folder / f"{name}.toml"
        site.write_text(SITE.format(transmission=transmission) + stations, encoding="utf-8")
        build_table(site, folder / f"{name}.h5", jobs=1)
    return folder


def reports(place: str, count: int, *, heard: Sequence[str] = ("a", "b", "c"), seed: int = 1) -> list[Report]:
    """Straight paths to stations, whatever is between, with errors of 2 deg."""
    rng = np.random.default_rng(seed)
    made = []
    for n in range(count):
        target = np.array([rng.uniform(*PLACES[place]), rng.uniform(0.5, 2.0), rng.uniform(0.5, 1.8)])
        angles = []
        for name in heard:
            x, y, z = target - STATIONS[name]
            azimuth = np.arctan2(y, x) + np.deg2rad(2.0) * rng.normal()
            zenith = np.arccos(z / np.linalg.norm([x, y, z])) + np.deg2rad(2.0) * rng.normal()
            stdev = np.deg2rad(2.0)
            angles.append(
                Angle(station_id=name, azimuth=azimuth, zenith=zenith, azimuth_stdev=stdev, zenith_stdev=stdev)
            )
        made.append(Report(measurements=tuple(angles), target_id=f"t{n % 2}"))
    return made


def tables(folder: Path) -> list[Table]:
    return [Table.open(folder / "opaque.h5"), Table.open(folder / "passed.h5")]


def test_a_table_says_what_its_walls_are(flat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    opaque, passed = tables(flat)
    assert not opaque.passes_walls
    assert passed.passes_walls
    for name, expected in (("opaque", "taken for opaque, as the site file says"), ("passed", "let signals through")):
        assert main(["info", str(flat / f"{name}.h5")]) == 0
        assert expected in capsys.readouterr().out
        assert main(["info", str(flat / f"{name}.h5"), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["opaque_walls"] is (name == "opaque")


def test_signals_through_the_wall_speak_for_the_table_that_knows_them(flat: Path) -> None:
    found = compare_tables(reports("behind", 24, heard=("a", "b")), tables(flat), jobs=1)
    opaque, passed = found.tables
    assert found.count == 24
    assert found.best is passed
    assert found.told
    assert opaque.inconsistent > 12
    assert passed.inconsistent == 0


def test_evidences_are_those_of_the_fixes(flat: Path) -> None:
    asked = reports("behind", 12)
    found = compare_tables(asked, tables(flat), jobs=1)
    for each in found.tables:
        locator = Locator(each.table)
        fixes = [locator.locate(report) for report in asked]
        evidence = [fix.log_evidence for fix in fixes]
        assert each.inconsistent == [fix.status for fix in fixes].count("inconsistent")
        assert each.total == pytest.approx(sum(evidence))
        assert each.mean == pytest.approx(np.mean(evidence))
    assert found.tables[0].difference == pytest.approx(found.tables[0].mean - found.tables[1].mean)


def test_a_log_of_what_both_tables_know_does_not_tell(flat: Path) -> None:
    """Targets before the wall that station c does not report: both tables have the same straight paths."""
    found = compare_tables(reports("before", 24, heard=("a", "b")), tables(flat), jobs=1)
    assert found.count == 24
    assert not found.told
    assert abs(found.tables[0].difference - found.tables[1].difference) < 0.1


def test_few_reports_do_not_tell(flat: Path) -> None:
    found = compare_tables(reports("behind", 9), tables(flat), jobs=1)
    assert found.best.table.passes_walls
    assert not found.told


def test_reports_that_a_table_cannot_answer_are_left_out(flat: Path) -> None:
    asked = reports("behind", 12)
    stranger = Report(
        measurements=(Angle(station_id="x", azimuth=0.0, zenith=1.6, azimuth_stdev=0.02, zenith_stdev=0.02),)
    )
    found = compare_tables([stranger, *asked], tables(flat), jobs=1)
    assert (found.count, found.left_out) == (12, 1)
    assert found.tables[0].total == pytest.approx(compare_tables(asked, tables(flat), jobs=1).tables[0].total)
    with pytest.raises(ReportError, match=r"none of 1 reports .* station .x. is not in the table"):
        compare_tables([stranger], tables(flat), jobs=1)


def test_standard_error_of_independent_values() -> None:
    values = np.random.default_rng(1).normal(size=4000)
    error = standard_error(values, ["t"] * 4000)
    assert 1.0 / np.sqrt(4000) * 0.97 < error < 1.0 / np.sqrt(4000) * 1.6


def test_standard_error_along_tracks() -> None:
    """An autoregression of 0.9 has a mean whose variance is (1 + 0.9) / (1 - 0.9) = 19 times that of independent ones.

    The reports of two targets alternate in the log.
    """
    rng = np.random.default_rng(2)
    tracks = np.zeros((2, 4000))
    tracks[:, 0] = rng.normal(size=2)
    for n in range(1, 4000):
        tracks[:, n] = 0.9 * tracks[:, n - 1] + np.sqrt(1.0 - 0.81) * rng.normal(size=2)
    error = standard_error(tracks.T.ravel(), ["a", "b"] * 4000)
    expected = np.sqrt(19.0 / 8000)
    assert 0.75 * expected < error < 1.7 * expected
    assert np.isnan(standard_error(np.ones(1), ["t"]))


def written(folder: Path, asked: Sequence[Report]) -> Path:
    path = folder / "log.jsonl"
    lines = []
    for report in asked:
        measurements = [
            {
                "type": "aoa",
                "station_id": m.station_id,
                "azimuth_deg": float(np.rad2deg(m.azimuth)),
                "zenith_deg": float(np.rad2deg(m.zenith)),
                "azimuth_stdev_deg": 2.0,
                "zenith_stdev_deg": 2.0,
            }
            for m in report.measurements
            if isinstance(m, Angle) and m.zenith is not None
        ]
        lines.append(json.dumps({"target_id": report.target_id, "measurements": measurements}))
    path.write_text("\n".join([*lines, "{no report"]), encoding="utf-8")
    return path


def test_the_command(flat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(flat / "opaque.h5"), str(flat / "passed.h5"), str(written(tmp_path, reports("behind", 24)))]
    assert main(["compare", *files, "--no-progress", "--jobs", "1"]) == 0
    out = capsys.readouterr().out
    assert f"{flat / 'passed.h5'} is ahead: it explains a report better than {flat / 'opaque.h5'} by" in out
    assert "1 entry is no report" in out
    assert main(["compare", *files, "--no-progress", "--jobs", "1", "--json", "--reports", "12"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["best"] == str(flat / "passed.h5")
    assert (document["reports"], document["reports_of_the_logs"], document["problems"]) == (12, 24, 1)
    opaque, passed = document["tables"]
    assert opaque["opaque_walls"]
    assert opaque["worse"]
    assert opaque["below_best"] == pytest.approx(passed["log_evidence"] - opaque["log_evidence"])
    assert main(["compare", *files, "--no-progress", "--jobs", "1", "--reports", "5"]) == 0
    assert "5 reports are too few to tell" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["opaque.h5", "log.jsonl"], "1 of the files is a table; give two or more"),
        (["opaque.h5", "passed.h5"], "give a log as well"),
        (["opaque.h5", "opaque.h5", "log.jsonl"], "is given twice"),
    ],
)
def test_what_cannot_be_compared(
    flat: Path, tmp_path: Path, names: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = written(tmp_path, reports("behind", 2))
    files = [str(log if name == "log.jsonl" else flat / name) for name in names]
    assert main(["compare", *files, "--no-progress"]) == 2
    assert message in capsys.readouterr().err
