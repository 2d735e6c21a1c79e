"""Cells that an update keeps and the loss of accuracy, by tolerance: objects of the bundled hall are moved and added.

For each change, the hall's table is updated with every tolerance and compared with the exact table (tolerance 0, which
equals a new build): cells that are kept, the held-out log-likelihood of kept cells under their new measure, and the
distance between the fixes of both tables. Tables are kept in ``--folder``; a second run only compares them.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.common.held_out import log_densities
from rayfix.example.files import SCENE_FILE, write_example
from rayfix.example.hall import hall_scene
from rayfix_evaluation.drops.accuracy import drop_uniformly
from rayfix_evaluation.drops.simulate import Noise, simulate_report
from rayfix_offline.build import BuildSummary, build_table
from rayfix_offline.fit.em import sample_points
from rayfix_offline.rays.trace import trace_station
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_service.locator import Locator
from rayfix_service.wire import parse_report
from rayfix_tables.table import Table

POINTS = 4000
"""Points that the held-out log-likelihood of a cell is the mean of."""


def add_crate(scene: trimesh.Scene) -> None:
    """Add a crate between machines."""
    crate = trimesh.creation.box(bounds=[(6.5, 8.0, 0.0), (7.3, 8.8, 0.9)])
    scene.add_geometry(crate, geom_name="crate", node_name="crate")


def move_cabinet(scene: trimesh.Scene) -> None:
    """Move a cabinet by half a metre."""
    scene.geometry["cabinet_1"].apply_translation((0.0, 0.5, 0.0))


def move_machine(scene: trimesh.Scene) -> None:
    """Move a machine, 1.2 x 1.5 x 2.2 m, by half a metre."""
    scene.geometry["machine_3"].apply_translation((0.5, 0.0, 0.0))


CHANGES: dict[str, Callable[[trimesh.Scene], None]] = {
    "crate added": add_crate,
    "cabinet moved": move_cabinet,
    "machine moved": move_machine,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="keep the tables here")
    parser.add_argument("--former", type=Path, help="the bundled hall's table; built when left out")
    parser.add_argument("--tolerances", type=float, nargs="+", default=[0.01, 0.03])
    parser.add_argument("--drops", type=int, default=200)
    parser.add_argument("--cells", type=int, default=100, help="kept cells that are judged held-out")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = options.folder or Path(name)
        former = options.former
        if former is None:
            former = folder / "hall.h5"
            build_table(write_example(folder / "hall"), former)
        for change, apply in CHANGES.items():
            study(change, apply, folder, former, options)


def study(
    change: str, apply: Callable[[trimesh.Scene], None], folder: Path, former: Path, options: argparse.Namespace
) -> None:
    """Update the hall's table for one change of the scene."""
    name = change.replace(" ", "-")
    site_path = write_example(folder / name)
    scene = hall_scene()
    apply(scene)
    (folder / name / SCENE_FILE).write_bytes(scene.export(file_type="glb"))
    exact_path = folder / f"{name}.h5"
    show(change, 0.0, build_table(site_path, exact_path, former=None if exact_path.exists() else former))
    for tolerance in options.tolerances:
        path = folder / f"{name}-{tolerance:g}.h5"
        begun = None if path.exists() else former
        show(change, tolerance, build_table(site_path, path, former=begun, tolerance=tolerance))
        exact, updated = Table.open(exact_path), Table.open(path)
        compare_cells(exact, updated, site_path, options.cells, options.seed)
        compare_fixes(exact, updated, options.drops, options.seed)


def show(change: str, tolerance: float, summary: BuildSummary) -> None:
    """Print what a build kept."""
    kept = ", ".join(f"{s.station_id} {s.num_kept_cells / s.num_finest_cells:.0%}" for s in summary.stations)
    largest = max(s.largest_change for s in summary.stations)
    print(
        f"{change}, tolerance {tolerance:.0%}: kept {kept} (changed by {largest:.1%}) in {summary.seconds:.0f} s",
        flush=True,
    )


def compare_cells(exact: Table, updated: Table, site_path: Path, count: int, seed: int) -> None:
    """Compare kept cells with those fitted to the new scene, on points drawn from the new scene's rays."""
    site = read_site(site_path)
    twin = prepare_twin(site, site_path.parent)
    rng = np.random.default_rng(seed)
    loss, mass = [], []
    per_station = -(-count // len(site.stations))
    for section in site.stations:
        part = updated.parts[section.id]
        if part.update is None:
            continue
        trace = trace_station(section, site, twin)
        rays = trace.finest
        kept = np.flatnonzero(part.update.cell_change[0])
        for cell in rng.choice(kept, min(len(kept), per_station), replace=False):
            points, _, _ = sample_points(rays.grid.centres[cell], rays, POINTS, rng)
            ours, theirs = (t.parts[section.id].levels[0] for t in (updated, exact))
            own, other = (log_densities(lv.cell(int(cell)), points)[0].mean() for lv in (ours, theirs))
            loss.append(other - own)
            mass.append(abs(ours.cell_log_mass[cell] - theirs.cell_log_mass[cell]))
    if loss:
        print(
            f"  held-out log-likelihood lost by {len(loss)} kept cells: mean {np.mean(loss):.5f}, 95 % "
            f"{np.percentile(loss, 95):.5f}, most {np.max(loss):.5f} nats; log of their mass off by "
            f"{np.mean(mass):.5f}, at most {np.max(mass):.5f}",
            flush=True,
        )


def compare_fixes(exact: Table, updated: Table, count: int, seed: int) -> None:
    """Locate the same reports with both tables."""
    drops = drop_uniformly(exact, count, np.random.default_rng([seed, 0]))
    locators = [Locator(table) for table in (exact, updated)]
    for degrees, timing in ((1.0, "none"), (1.0, "pt"), (0.25, "pt")):
        angle = float(np.deg2rad(degrees))
        noise = Noise(azimuth_stdev=angle, zenith_stdev=angle, range_stdev=0.5 if timing != "none" else None)
        rng = np.random.default_rng([seed, 1])
        apart, errors = [], []
        for drop in drops:
            if not drop.paths:
                continue
            report = parse_report(simulate_report(drop.paths, noise, rng=rng, timing=timing))
            fixes = [locator.locate(report).position for locator in locators]
            if all(fix is not None for fix in fixes):
                apart.append(np.linalg.norm(fixes[0] - fixes[1]))
                errors.append([np.linalg.norm(fix - drop.position) for fix in fixes])
        e90 = np.percentile(errors, 90, axis=0)
        a50, a90, a99 = np.percentile(apart, [50, 90, 99])
        print(
            f"  {degrees:g} deg, {timing}: fixes apart by {1e3 * a50:.2f} mm (50 %), {1e3 * a90:.2f} mm (90 %), "
            f"{1e3 * a99:.1f} mm (99 %); error, 90 %: {e90[1]:.3f} m, exact table {e90[0]:.3f} m",
            flush=True,
        )


if __name__ == "__main__":
    main()
