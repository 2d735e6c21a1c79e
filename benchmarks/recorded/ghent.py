"""Real UWB ranges in an industrial hall, most of them without line of sight, by calibration on half of the places.

Reads ``meta_IIoT_19.csv`` of J. Fontaine's UWB data set, plain or gzip, with coordinates and ranges in mm: 19 anchors,
14 places. Each half of the places is judged with the calibration by the other. No licence is stated, so the data are no
part of this repository. The twin is an empty hall, since racks and machines are not in the data (docs/real-data.md).
"""

import argparse
import csv
import gzip
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rayfix_evaluation.calibration.held_out import judge, only
from rayfix_evaluation.calibration.measured import KnownReport
from rayfix_evaluation.calibration.site import calibrate_site
from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_offline.build import build_table
from rayfix_service.fusion.fusion import Fusion
from rayfix_service.fusion.measurements.report import Height, Range, Report
from rayfix_service.fusion.posterior.fixes import make_fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_tables.site import SiteInfo
from rayfix_tables.table import Table

Array = NDArray[np.float64]

FILE = Path(__file__).resolve().parents[3] / "shared" / "data" / "on-air" / "ghent-iiot19.csv.gz"
STATED = 0.2  # m, deviation of a range before calibration
HEIGHT_STDEV = 0.05  # m
HEAD = """
[site]
name = "hall"
[room]
size_m = [25.0, 11.0, 6.0]
[propagation]
carrier_ghz = 6.5
max_reflections = 0
max_path_length_m = 40.0
[table]
windows_deg = [10.0]
"""


@dataclass(frozen=True, kw_only=True)
class Place:
    """A place of the tag, m, and its ranges by anchor, m."""

    position: Array
    ranges: dict[str, Array]


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Horizontal errors of fixes, m, and whether circles of 68 and 90 % hold the truth."""

    error: list[float]
    held: list[tuple[bool, bool]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=FILE, help="the file")
    parser.add_argument("--reports", type=int, default=30, help="reports of a place")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    anchors, places = read(options.data)
    rng = np.random.default_rng(options.seed)
    order = rng.permutation(len(places))
    rows: dict[tuple[str, str], list[Judged]] = {}
    with tempfile.TemporaryDirectory() as folder:
        table = hall_table(Path(folder), anchors)
        solver = solver_of(table)
        for half in (0, 1):
            known = reports_of([places[n] for n in order[half::2]], len(anchors), options.reports, rng)
            found = calibrate_site(known, table.site, solver)
            judgement = judge(known, table, solver, found)
            site = only(judgement.part, found, table.site).site
            print(f"half {half + 1}: taken is {judgement.part}; held-out log evidence {judgement.evidence}", flush=True)
            for count, name in ((len(anchors), "all anchors"), (4, "four anchors")):
                judged = reports_of([places[n] for n in order[1 - half :: 2]], count, options.reports, rng)
                for label, locate in {
                    "least squares": lambda report: (squares(report, anchors, "linear"), None),
                    "soft L1": lambda report: (squares(report, anchors, "soft_l1"), None),
                    "rayfix as stated": fixer(table, table.site),
                    "rayfix calibrated": fixer(table, site),
                }.items():
                    rows.setdefault((name, label), []).append(judge_reports(judged, locate))
    print(f"{'':32} 50 %   90 %   rms   in the circle of 68, 90 %")
    for (name, label), halves in rows.items():
        error = np.concatenate([each.error for each in halves])
        held = np.array([pair for each in halves for pair in each.held])
        shares = "  ".join(f"{share:4.0%}" for share in held.mean(axis=0)) if held.size else ""
        figures = [*np.percentile(error, [50, 90]), np.sqrt(np.mean(error**2))]
        print(f"{name + ', ' + label:32} " + " ".join(f"{value:5.2f}" for value in figures) + f"   {shares}")


def read(path: Path) -> tuple[dict[str, Array], list[Place]]:
    """Read anchors and places."""
    anchors: dict[str, Array] = {}
    places: dict[str, tuple[Array, dict[str, list[float]]]] = {}
    content = path.read_bytes()
    text = (gzip.decompress(content) if path.suffix == ".gz" else content).decode("utf-8")
    for row in csv.DictReader(text.splitlines()):
        anchor = f"a{float(row['anchorNumber']):.0f}"
        anchors[anchor] = np.array([float(row[f"{axis}_anchor"]) for axis in "xyz"]) / 1000.0
        tag = np.array([float(row[f"{axis}_tag"]) for axis in "xyz"]) / 1000.0
        _, ranges = places.setdefault(row["location_ID"], (tag, {}))
        ranges.setdefault(anchor, []).append(float(row["estimated_range"]) / 1000.0)
    return anchors, [
        Place(position=tag, ranges={name: np.array(values) for name, values in ranges.items()})
        for tag, ranges in places.values()
    ]


def hall_table(folder: Path, anchors: dict[str, Array]) -> Table:
    stations = "".join(f'[[stations]]\nid = "{name}"\nposition_m = {at.tolist()}\n' for name, at in anchors.items())
    (folder / "site.toml").write_text(HEAD + stations, encoding="utf-8")
    build_table(folder / "site.toml", folder / "hall.h5")
    return Table.open(folder / "hall.h5")


def reports_of(places: Sequence[Place], count: int, num_reports: int, rng: np.random.Generator) -> list[KnownReport]:
    """Draw reports of one range of each of so many anchors."""
    found = []
    for number, place in enumerate(places):
        for n in range(num_reports):
            names = sorted(place.ranges)
            names = sorted(rng.choice(names, min(count, len(names)), replace=False).tolist())
            ranges = tuple(
                Range(station_id=name, path_length=float(rng.choice(place.ranges[name])), stdev=STATED)
                for name in names
            )
            report = Report(measurements=ranges, height=Height(z=float(place.position[2]), stdev=HEIGHT_STDEV))
            x, y, z = place.position.tolist()
            found.append(KnownReport(report=report, position=(x, y, z), seconds=100.0 * number + n, place=number))
    return found


Locate = Callable[[Report], tuple[Array | None, Array | None]]


def fixer(table: Table, site: SiteInfo) -> Locate:
    settings = FusionSettings()
    fusion = Fusion(table, settings)

    def locate(report: Report) -> tuple[Array | None, Array | None]:
        fix = make_fix(report, fusion.product(report, site=site), table, settings)
        radii = None if fix.regions is None else np.array(fix.regions.horizontal_radii((0.68, 0.9)))
        return fix.position, radii

    return locate


def squares(report: Report, anchors: dict[str, Array], loss: str) -> Array:
    """Fit the position in the plane by least squares, from the middle of the anchors."""
    assert report.height is not None
    height = report.height.z
    at = np.array([anchors[m.station_id] for m in report.measurements if isinstance(m, Range)])
    lengths = np.array([m.path_length for m in report.measurements if isinstance(m, Range)])

    def residual(x: Array) -> Array:
        return np.linalg.norm(np.append(x, height) - at, axis=1) - lengths

    return np.append(least_squares(residual, at.mean(axis=0)[:2], loss=loss, f_scale=0.15).x, height)


def judge_reports(reports: Sequence[KnownReport], locate: Locate) -> Judged:
    error, held = [], []
    for known in reports:
        position, radii = locate(known.report)
        apart = np.inf if position is None else float(np.hypot(*(position - np.array(known.position))[:2]))
        error.append(apart)
        if radii is not None:
            held.append((apart <= radii[0], apart <= radii[1]))
    return Judged(error=error, held=held)


if __name__ == "__main__":
    main()
