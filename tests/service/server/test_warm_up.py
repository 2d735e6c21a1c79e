"""A service that has warmed up compiles nothing in a request."""

import json
import subprocess
import sys
from pathlib import Path

CODE = """
import json, pkgutil, importlib, sys
import rayfix_service.fusion, rayfix_service.tracking, rayfix_tables.gaussians.tree_reduction
from rayfix_service.locator import Locator
from rayfix_service.tracking.tracker import Tracker
from rayfix_service.wire import parse_report
from rayfix_tables.table import Table

packages = rayfix_service.fusion, rayfix_service.tracking
names = [m.name for p in packages for m in pkgutil.walk_packages(p.__path__, p.__name__ + ".")]
modules = [rayfix_tables.gaussians.tree_reduction, *(importlib.import_module(name) for name in names)]

def compiled():
    kernels = [(m.__name__, n, k) for m in modules for n, k in vars(m).items() if hasattr(k, "signatures")]
    return {(m, n): len(k.signatures) for m, n, k in kernels}

locator = Locator(Table.open(sys.argv[1]))
locator.warm_up()
tracker = Tracker(locator.table)
tracker.warm_up()
warm = compiled()
for document in json.loads(sys.argv[2]):
    fix = locator.locate(parse_report(document))
    fix.regions.ellipsoid(0.9)
for second, document in enumerate(json.loads(sys.argv[2])):
    timed = {**document, "target_id": "a", "timestamp": f"2026-01-31T10:00:0{second}Z"}
    track = tracker.follow(locator.fuse(timed))
    track.regions.ellipsoid(0.9), track.regions.upright_ellipsoid(0.9), track.regions.accuracies(0.9)
print(json.dumps([sum(warm.values()), [f"{m}.{n}" for (m, n), k in compiled().items() if k != warm[m, n]]]))
"""


def test_reports_of_all_kinds_find_their_kernels_compiled(hall_table_path: Path) -> None:
    places = [("bs1", 70.0, 96.0, 15.0), ("bs2", -110.0, 97.0, 9.0), ("bs3", 20.0, 100.0, 7.0)]
    angles = [
        {
            "type": "aoa",
            "station_id": name,
            "azimuth_deg": azimuth,
            "zenith_deg": zenith,
            "azimuth_stdev_deg": 1.0,
            "zenith_stdev_deg": 1.0,
        }
        for name, azimuth, zenith, _ in places
    ]
    wide = [{**angle, "azimuth_stdev_deg": 7.0, "zenith_stdev_deg": 7.0} for angle in angles]
    times = {
        kind: [{"type": kind, "station_id": name, "range_m": length, "stdev_m": 0.5} for name, *_, length in places]
        for kind in ("pt", "toa")
    }
    azimuths = [{k: v for k, v in angle.items() if not k.startswith("zenith")} for angle in angles]
    heavy = [{**angle, "error_model": "heavy_tailed"} for angle in angles]
    kinds = [
        angles,
        wide,
        azimuths,
        heavy,
        times["pt"],
        angles + times["pt"],
        wide + times["pt"],
        angles + times["toa"],
    ]
    reports = json.dumps([{"measurements": measurements} for measurements in kinds])
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(hall_table_path), reports],
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    num_compiled, late = json.loads(done.stdout)
    assert num_compiled > 10
    assert late == []
