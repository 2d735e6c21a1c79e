"""Recorded Bluetooth angles: half-second medians located in an empty box, beside least squares.

The recordings are not part of the project: four u-blox anchors in the corners of 6.0 x 4.8 m at 1.38 m, a tag at
surveyed places (Byongho96/ble-localization, folder 0317, 2025; no licence is stated). ``--data`` names the folder with
``diagonal.csv.gz`` and ``obstacle.csv.gz`` (timestamp_ms, anchor, azimuth_deg, elevation_deg) and ``*-truth.csv``
(start_ms, end_ms, x_m, y_m, z_m). In the second, a person or a board stands before an anchor. ``68`` and ``90`` are the
percentages of true places within the stated circles. ``--calibrate`` calibrates the stations on one recording and
judges on the other, without the angles of the blocked anchor; and on the first quarter of the places of one.
"""

import argparse
import csv
import gzip
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rayfix_evaluation.calibration.held_out import judge, only
from rayfix_evaluation.calibration.measured import KnownReport
from rayfix_evaluation.calibration.site import calibrate_site
from rayfix_evaluation.drops.accuracy import solver_of
from rayfix_offline.build import build_table
from rayfix_service.fusion.fusion import Fusion
from rayfix_service.fusion.measurements.report import Angle, ErrorModel, Height, Report
from rayfix_service.fusion.posterior.fixes import make_fix
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

ANCHORS = {
    "1": ((0.0, 4.8, 1.38), 135.0),
    "2": ((6.0, 4.8, 1.38), 225.0),
    "3": ((6.0, 0.0, 1.38), 315.0),
    "4": ((0.0, 0.0, 1.38), 45.0),
}
"""Positions, and bearings clockwise from +y."""

TAILS = ErrorModel(tail_share=0.2, tail_scale=3.0)
SITE = """
[site]
name = "box"
[room]
size_m = [6.0, 4.8, 2.6]
[propagation]
max_reflections = 0
[table]
windows_deg = [5, 15]
"""
Array = NDArray[np.float64]


def site(folder: Path) -> Path:
    """Write the site file of an empty box, with the anchors in its corners."""
    stations = [
        f'[[stations]]\nid = "{name}"\nposition_m = {(np.array(at)).round(3).tolist()}\n'
        for name, (at, _) in ANCHORS.items()
    ]
    path = folder / "box.toml"
    path.write_text(SITE + "".join(stations))
    return path


@dataclass(frozen=True, kw_only=True)
class HalfSecond:
    """Median azimuth and elevation of each anchor, rad, and where the tag was."""

    place: Array
    number: int
    seconds: float
    blocked: str
    seen: dict[str, tuple[float, float]]

    def report(self, stdev: float, *, with_blocked: bool = True) -> Report:
        """Report the angles of all anchors, or of those that nothing was held before."""
        angles = tuple(
            Angle(
                station_id=anchor,
                azimuth=azimuth,
                zenith=0.5 * np.pi - elevation,
                azimuth_stdev=stdev,
                zenith_stdev=stdev,
                error_model=TAILS,
            )
            for anchor, (azimuth, elevation) in self.seen.items()
            if with_blocked or anchor != self.blocked
        )
        return Report(measurements=angles, height=Height(z=float(self.place[2]), stdev=0.1))


def dwells(folder: Path, name: str) -> Iterator[HalfSecond]:
    """Give the half seconds of a recording."""
    with (folder / f"{name}-truth.csv").open() as file:
        truth = list(csv.DictReader(file))
    with gzip.open(folder / f"{name}.csv.gz", "rt") as file:
        packets = [
            (int(row["timestamp_ms"]), row["anchor"], float(row["azimuth_deg"]), float(row["elevation_deg"]))
            for row in csv.DictReader(file)
        ]
    for number, row in enumerate(truth):
        begin, end = int(row["start_ms"]), int(row["end_ms"])
        slots: defaultdict[int, defaultdict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
        for time, anchor, azimuth, elevation in packets:
            if begin <= time < end:
                slots[(time - begin) // 500][anchor].append((azimuth, elevation))
        place = np.array([float(row[axis]) for axis in ("x_m", "y_m", "z_m")])
        for slot, anchors in slots.items():
            yield HalfSecond(
                place=place,
                number=number,
                seconds=0.001 * begin + 0.5 * slot,
                blocked=row.get("blocked_anchor") or "0",
                seen={
                    anchor: (
                        float(np.deg2rad(90.0 - ANCHORS[anchor][1] - median(azimuth for azimuth, _ in seen))),
                        float(np.deg2rad(median(elevation for _, elevation in seen))),
                    )
                    for anchor, seen in anchors.items()
                },
            )


def judge_calibrations(folder: Path, table: Table, stdev: float) -> None:
    """Calibrate on one part of the recordings, and locate another with and without that."""
    parts = {
        name: [each for each in dwells(folder, name) if set(each.seen) - {each.blocked}]
        for name in ("diagonal", "obstacle")
    }
    quarter = sorted({each.number for each in parts["diagonal"]})
    quarter = quarter[: len(quarter) // 4]
    first = [each for each in parts["diagonal"] if each.number in quarter]
    rest = [each for each in parts["diagonal"] if each.number not in quarter]
    solver, settings = solver_of(table), FusionSettings()
    fusion = Fusion(table, settings)
    for label, known, judged in (
        ("diagonal, judged on obstacle", parts["diagonal"], parts["obstacle"]),
        ("obstacle, judged on diagonal", parts["obstacle"], parts["diagonal"]),
        ("first quarter of diagonal, judged on the rest", first, rest),
    ):
        reports = [
            KnownReport(
                report=each.report(stdev, with_blocked=False),
                position=(float(each.place[0]), float(each.place[1]), float(each.place[2])),
                seconds=each.seconds,
                place=each.number,
            )
            for each in known
        ]
        found = calibrate_site(reports, table.site, solver)
        judgement = judge(reports, table, solver, found)
        calibrated = only(judgement.part, found, table.site).site
        line = [f"{label}: takes {judgement.part}"]
        for site in (table.site, calibrated):
            errors, held = [], []
            for each in judged:
                report = each.report(stdev, with_blocked=False)
                fix = make_fix(report, fusion.product(report, site=site), table, settings)
                if fix.position is None or fix.regions is None:
                    continue
                errors.append(float(np.hypot(*(fix.position - each.place)[:2])))
                held.append([errors[-1] <= radius for radius in fix.regions.horizontal_radii((0.68, 0.9))])
            inside = 100.0 * np.mean(held, axis=0)
            line.append(f"{np.mean(errors):.3f} m, 68 {inside[0]:.0f} %, 90 {inside[1]:.0f} %")
        print("; ".join(line), flush=True)


def straight(seen: dict[str, tuple[float, float]], z: float, loss: str) -> Array:
    """Least squares on the azimuths at a known height."""

    def residuals(at: Array) -> Array:
        apart = [
            np.arctan2(at[1] - ANCHORS[name][0][1], at[0] - ANCHORS[name][0][0]) - azimuth
            for name, (azimuth, _) in seen.items()
        ]
        return np.asarray(np.angle(np.exp(1j * np.array(apart))) / np.deg2rad(10.0))

    return np.append(least_squares(residuals, [3.2, 2.6], loss=loss).x, z)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--degrees", type=float, default=10.0)
    parser.add_argument("--gaussians", action="store_true", help="without the path map, as tables had none")
    parser.add_argument("--calibrate", action="store_true", help="judge calibrations instead")
    options = parser.parse_args()
    stdev = float(np.deg2rad(options.degrees))
    with tempfile.TemporaryDirectory() as folder:
        build_table(site(Path(folder)), Path(folder) / "box.h5")
        table = Table.open(Path(folder) / "box.h5")
        if options.gaussians:
            table = replace(table, parts={name: replace(part, paths=None) for name, part in table.parts.items()})
        if options.calibrate:
            judge_calibrations(options.data, table, stdev)
            return
        locator = Locator(table)
        for name in ("diagonal", "obstacle"):
            errors: defaultdict[str, list[float]] = defaultdict(list)
            held: defaultdict[float, list[bool]] = defaultdict(list)
            for each in dwells(options.data, name):
                place, seen = each.place, each.seen
                fix = locator.locate(each.report(stdev))
                if fix.position is None or fix.regions is None:
                    continue
                off = float(np.hypot(*(fix.position - place)[:2]))
                errors["rayfix"].append(off)
                for probability in (0.68, 0.90):
                    held[probability].append(off <= fix.regions.horizontal_radius(probability))
                if len(seen) > 1:
                    for loss in ("linear", "huber"):
                        errors[loss].append(float(np.hypot(*(straight(seen, place[2], loss) - place)[:2])))
            means = "  ".join(f"{method} {np.mean(values):.3f} m" for method, values in errors.items())
            circles = "  ".join(f"{100 * p:.0f} {100 * np.mean(values):.1f} %" for p, values in held.items())
            print(f"{name}: {len(errors['rayfix'])} half seconds, mean error {means}; {circles}", flush=True)


if __name__ == "__main__":
    main()
