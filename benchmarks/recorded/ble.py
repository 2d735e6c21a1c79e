"""Recorded Bluetooth angles: half-second medians located in an empty box, beside least squares.

The recordings are not part of the project: four u-blox anchors in the corners of 6.0 x 4.8 m at 1.38 m, a tag at
surveyed places (Byongho96/ble-localization, folder 0317, 2025; no licence is stated). ``--data`` names the folder with
``diagonal.csv.gz`` and ``obstacle.csv.gz`` (timestamp_ms, anchor, azimuth_deg, elevation_deg) and ``*-truth.csv``
(start_ms, end_ms, x_m, y_m, z_m). In the second, a person or a board stands before an anchor. ``68`` and ``90`` are the
percentages of true places within the stated circles.
"""

import argparse
import csv
import gzip
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rayfix_offline.build import build_table
from rayfix_service.fusion.measurements.report import Angle, ErrorModel, Height, Report
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


def dwells(folder: Path, name: str) -> Iterator[tuple[Array, dict[str, tuple[float, float]]]]:
    """Give the place and the median azimuth and elevation of each anchor, rad, of each half second."""
    with (folder / f"{name}-truth.csv").open() as file:
        truth = list(csv.DictReader(file))
    with gzip.open(folder / f"{name}.csv.gz", "rt") as file:
        packets = [
            (int(row["timestamp_ms"]), row["anchor"], float(row["azimuth_deg"]), float(row["elevation_deg"]))
            for row in csv.DictReader(file)
        ]
    for row in truth:
        begin, end = int(row["start_ms"]), int(row["end_ms"])
        slots: defaultdict[int, defaultdict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
        for time, anchor, azimuth, elevation in packets:
            if begin <= time < end:
                slots[(time - begin) // 500][anchor].append((azimuth, elevation))
        place = np.array([float(row[axis]) for axis in ("x_m", "y_m", "z_m")])
        for slot in slots.values():
            yield (
                place,
                {
                    anchor: (
                        float(np.deg2rad(90.0 - ANCHORS[anchor][1] - median(azimuth for azimuth, _ in seen))),
                        float(np.deg2rad(median(elevation for _, elevation in seen))),
                    )
                    for anchor, seen in slot.items()
                },
            )


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
    options = parser.parse_args()
    stdev = float(np.deg2rad(options.degrees))
    with tempfile.TemporaryDirectory() as folder:
        build_table(site(Path(folder)), Path(folder) / "box.h5")
        table = Table.open(Path(folder) / "box.h5")
        if options.gaussians:
            table = replace(table, parts={name: replace(part, paths=None) for name, part in table.parts.items()})
        locator = Locator(table)
        for name in ("diagonal", "obstacle"):
            errors: defaultdict[str, list[float]] = defaultdict(list)
            held: defaultdict[float, list[bool]] = defaultdict(list)
            for place, seen in dwells(options.data, name):
                angles = tuple(
                    Angle(
                        station_id=anchor,
                        azimuth=azimuth,
                        zenith=0.5 * np.pi - elevation,
                        azimuth_stdev=stdev,
                        zenith_stdev=stdev,
                        error_model=TAILS,
                    )
                    for anchor, (azimuth, elevation) in seen.items()
                )
                fix = locator.locate(Report(measurements=angles, height=Height(z=float(place[2]), stdev=0.1)))
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
