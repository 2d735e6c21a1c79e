"""Fixes of one 60 GHz station at recorded places of the Kampusareena, in a twin that is drawn from the plan.

The recording is O. Kaltiokallio's (`Robust-snapshot-radio-SLAM`, `measurements/kampusareena.mat` there; arXiv
2404.10291): 45 places with 4 to 11 paths each, as length, azimuth at the station, azimuth at the UE and power. It
states no licence: this reads the user's copy. The UE's clock counts as unknown, and its own azimuth is not used. Walls
are those of the plan, read off in metres; everything is in one horizontal plane.
"""

import argparse
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import trimesh
from numpy.typing import NDArray

from rayfix_offline.build import build_table
from rayfix_service.fusion.settings import FusionSettings
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

Array = NDArray[np.float64]

DATA = Path("../shared/data/on-air/kampusareena.mat")
HEIGHT, LEVEL = 0.6, 0.3  # m, of the twin, and of station and UE in it
TOWARD = -90.0  # deg, azimuth of the station's boresight
OFFSET = 57.3  # m, of the UE's clock; any number

BLOCKS = (
    ((-7.0, 0.0), (0.0, 4.0)),
    ((4.5, 0.0), (11.0, 4.0)),
    ((4.75, -1.0), (5.74, 0.0)),
)
"""Low and high corners of rooms and of a cupboard, m."""

WALLS = (
    ((-7.0, -5.5), (-5.7, -5.27)),
    ((-5.3, -5.2), (0.05, -4.4)),
    ((-6.97, -8.96), (-5.77, -8.2), (-4.47, -7.75), (-2.77, -7.47)),
    (
        (-6.97, -10.7), (-5.5, -9.8), (-3.9, -9.0), (-2.8, -8.75), (-1.46, -8.7), (-0.3, -9.05), (0.75, -9.8),
        (1.66, -10.83), (2.27, -12.0),
    ),
    (
        (11.0, -4.1), (10.27, -4.13), (9.6, -4.5), (8.57, -7.05), (8.36, -8.0), (8.57, -9.0), (9.4, -12.0),
    ),
)  # fmt: skip
"""Middle lines of thin walls: glass, stairs, the curved desk, and the wall on the right, m."""

PILLARS = ((-5.48, -5.24), (0.24, -4.33), (2.92, -4.44), (-5.48, -6.89))
PILLAR_RADIUS, WALL_THICKNESS = 0.21, 0.12  # m

SITE = """
[site]
name = "kampusareena"
scene = "plan.ply"
[propagation]
carrier_ghz = 60.0
max_reflections = {reflections}
max_path_length_m = 40.0
reflection_loss_db = {loss}
[table]
windows_deg = [2.0, 10.0]
[[stations]]
id = "bs"
position_m = [2.25, 2.5, {level}]
"""


def plan() -> trimesh.Trimesh:
    """Extrude the plan."""
    parts = [trimesh.creation.box(bounds=[[*low, 0.0], [*high, HEIGHT]]) for low, high in BLOCKS]
    for line in WALLS:
        for a, b in pairwise(line):
            start, end = np.array(a), np.array(b)
            length = float(np.linalg.norm(end - start))
            wall = trimesh.creation.box(extents=[length, WALL_THICKNESS, HEIGHT])
            turn = trimesh.transformations.rotation_matrix(np.arctan2(*(end - start)[::-1]), [0, 0, 1])
            turn[:3, 3] = [*(0.5 * (start + end)), 0.5 * HEIGHT]
            parts.append(wall.apply_transform(turn))
    for x, y in PILLARS:
        pillar = trimesh.creation.cylinder(radius=PILLAR_RADIUS, height=HEIGHT, sections=16)
        parts.append(pillar.apply_translation([x, y, 0.5 * HEIGHT]))
    # The frame of the plan bounds the free space.
    parts += [
        trimesh.creation.box(bounds=[[-7.2, -12.2, 0.0], [-7.0, 4.2, HEIGHT]]),
        trimesh.creation.box(bounds=[[11.0, -12.2, 0.0], [11.2, 4.2, HEIGHT]]),
        trimesh.creation.box(bounds=[[-7.0, -12.2, 0.0], [11.0, -12.0, HEIGHT]]),
        trimesh.creation.box(bounds=[[-7.0, 4.0, 0.0], [11.0, 4.2, HEIGHT]]),
    ]
    whole: trimesh.Trimesh = trimesh.util.concatenate(parts)
    return whole


@dataclass(frozen=True, kw_only=True)
class Place:
    """A place, its paths as rows of length [m], azimuth [rad] and power [dB], and which is the direct one."""

    position: Array
    paths: Array
    direct: NDArray[np.bool_]


def places(path: Path) -> list[Place]:
    recorded = scipy.io.loadmat(path, squeeze_me=True)["sim"]
    found = []
    for n in range(recorded["rx"].item().shape[1]):
        measured, power = recorded["y"].item()[n], recorded["power"].item()[n]
        order = np.argsort(-power)
        found.append(
            Place(
                position=np.asarray(recorded["rx"].item()[:2, n], float),
                paths=np.stack([measured[0], measured[1], power], axis=1)[order],
                direct=recorded["inlier"].item()[n][0].astype(bool)[order],
            )
        )
    return found


def report(place: Place, options: argparse.Namespace, *, direct: bool) -> dict[str, Any]:
    """Paths of a place, the strongest ones, with or without the direct one."""
    rows = place.paths if direct else place.paths[~place.direct]
    return {
        "height": {"z_m": LEVEL, "stdev_m": 0.05},
        "measurements": [
            {
                "type": "path",
                "station_id": "bs",
                "azimuth_deg": float((TOWARD - options.heading_deg + np.degrees(azimuth) + 180.0) % 360.0 - 180.0),
                "azimuth_stdev_deg": options.azimuth_stdev_deg,
                "toa_m": float(length) + OFFSET,
                "stdev_m": options.stdev_m,
            }
            for length, azimuth, _ in rows[: options.paths]
        ],
    }


def judge(locator: Locator, recorded: list[Place], options: argparse.Namespace, *, direct: bool) -> str:
    error, held, statuses = [], [], []
    for place in recorded:
        fix = locator.locate(report(place, options, direct=direct))
        off = np.inf if fix.position is None else float(np.linalg.norm(fix.position[:2] - place.position))
        error.append(off)
        statuses.append(fix.status)
        held.append(fix.regions is not None and fix.regions.ellipsoid(0.9).holds(np.array([*place.position, LEVEL])))
        if options.each:
            print(place.position, fix.status, f"{off:.2f} m", "held" if held[-1] else "")
    half, most = np.quantile(error, (0.5, 0.9), method="inverted_cdf")
    counts = {status: statuses.count(status) for status in sorted(set(statuses))}
    rms = float(np.sqrt(np.mean(np.square(error))))
    return f"RMSE {rms:.3f}  50 {half:.3f}  90 {most:.3f}  held {100 * np.mean(held):.0f}  {counts}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="your copy of kampusareena.mat")
    parser.add_argument("--table", type=Path, help="of the twin; built when left out")
    parser.add_argument("--paths", type=int, default=5, help="strongest paths of a place that are used")
    parser.add_argument("--reflections", type=int, default=2)
    parser.add_argument("--loss-db", type=float, default=10.0, help="of a reflection")
    parser.add_argument("--heading-deg", type=float, default=1.6, help="error of the station's heading, taken off")
    parser.add_argument("--azimuth-stdev-deg", type=float, default=2.0)
    parser.add_argument("--stdev-m", type=float, default=0.15)
    parser.add_argument("--spurious-paths", type=float, default=1.0, help="that are expected of a place")
    parser.add_argument("--each", action="store_true", help="also print each place")
    options = parser.parse_args()
    recorded = places(options.data)
    with tempfile.TemporaryDirectory() as folder:
        path = options.table or Path(folder) / "table.h5"
        if not path.exists():
            plan().export(Path(folder) / "plan.ply")
            site = SITE.format(reflections=options.reflections, loss=options.loss_db, level=LEVEL)
            (Path(folder) / "site.toml").write_text(site)
            build_table(Path(folder) / "site.toml", path)
        locator = Locator(Table.open(path), FusionSettings(spurious_paths=options.spurious_paths))
        print("all paths:      ", judge(locator, recorded, options, direct=True), flush=True)
        print("without direct: ", judge(locator, recorded, options, direct=False), flush=True)


if __name__ == "__main__":
    main()
