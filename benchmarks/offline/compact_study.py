"""What compact components cost and save: the same table in both forms, judged by held-out points and by fixes.

The first part fits cells of the bundled hall, and compares their held-out log-likelihood in single precision, as
tables had it until version 4 of the format, with that of compact components. The second part takes a table of version
4, writes a compact copy of it, and compares bytes, opening times, and the answers of both to the same simulated
reports.

    python -m benchmarks.offline.compact_study --whole hall-4.h5
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.held_out import REFERENCE_RATIO, log_densities, trace_sliced
from rayfix.example.files import write_example
from rayfix_evaluation.drops.accuracy import Drop, drop_uniformly
from rayfix_evaluation.drops.simulate import Noise, Timing, select_path, simulate_report
from rayfix_offline.fit.em import sample_points
from rayfix_offline.fit.settings import TubeFit
from rayfix_offline.fit.tubes import fit_tubes
from rayfix_offline.rays.trace import trace_station
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_service.locator import Locator
from rayfix_tables.compact.tubes import compacted
from rayfix_tables.mixture import TubeMixture
from rayfix_tables.table import Table
from rayfix_tables.write import write_table

HELD_OUT_POINTS = 1000

KINDS: tuple[tuple[str, float, Timing], ...] = (
    ("azimuth, zenith", 0.25, "none"),
    ("azimuth, zenith", 0.25, "pt"),
    ("azimuth, zenith", 1.0, "none"),
    ("azimuth, zenith", 1.0, "pt"),
    ("azimuth, zenith", 1.0, "tdoa"),
    ("azimuth, zenith", 1.5, "pt"),
    ("azimuth, zenith", 3.0, "none"),
    ("azimuth, zenith", 3.0, "pt"),
    ("azimuth, zenith", 10.0, "pt"),
    ("azimuth", 1.0, "pt"),
    ("azimuth", 4.0, "pt"),
    ("no angle", 1.0, "pt"),
    ("no angle", 1.0, "tdoa"),
)
"""Angles that are measured, their standard deviation in degrees, and times."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--whole", type=Path, metavar="TABLE", help="table of version 4; without it, no fixes")
    parser.add_argument("--cells", type=int, default=200, help="random cells of the hall (default 200)")
    parser.add_argument("--drops", type=int, default=200, help="reports of each kind (default 200)")
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    compare_held_out(options.cells, options.seed)
    if options.whole is not None:
        whole = Table.open(options.whole)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "compact.h5"
            write_compact(whole, path)
            compact = Table.open(path)
            compare_sizes(whole, compact)
            compare_fixes(whole, compact, options.drops, options.seed)


def compare_held_out(count: int, seed: int) -> None:
    """Print how the log-likelihood of held-out points changes in cells of the finest window."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_example(folder)
        site = read_site(path)
        twin = prepare_twin(site, path.parent)
    changes = []
    for s, section in enumerate(site.stations):
        rays, reference = trace_station(section, site, twin).finest, trace_sliced(s, site, twin, REFERENCE_RATIO)
        rng = np.random.default_rng([seed, s])
        cells = np.sort(rng.choice(rays.grid.num_cells, -(-count // len(site.stations)), replace=False))
        centres = rays.grid.centres[cells]
        counts, _, mixture, _ = fit_tubes(centres, rays, TubeFit())
        single, compact = mixture.as_stored(), compacted(mixture, rays.window)
        for n, (centre, end) in enumerate(zip(centres, np.cumsum(counts), strict=True)):
            points, _, _ = sample_points(centre, reference, HELD_OUT_POINTS, np.random.default_rng([seed, s, n]))
            if len(points) and counts[n]:
                of_cell = slice(int(end - counts[n]), int(end))
                changes.append(_change(compact[of_cell], single[of_cell], points))
    change = np.array(changes)
    print("| held-out log-likelihood, nats | mean | median cell | worst cell | best cell |\n|---|--:|--:|--:|--:|")
    for name, column in zip(("joint", "position given length and angles"), change.T, strict=True):
        error = column.std(ddof=1) / np.sqrt(len(column))
        print(
            f"| {name}, {len(column)} cells | {column.mean():+.5f} ± {error:.5f} | {np.median(column):+.5f} "
            f"| {column.min():+.4f} | {column.max():+.4f} |"
        )


def _change(compact: TubeMixture, single: TubeMixture, points: NDArray[np.float64]) -> list[float]:
    pairs = zip(log_densities(compact, points), log_densities(single, points), strict=True)
    return [float((ours - theirs).mean()) for ours, theirs in pairs]


def write_compact(whole: Table, path: Path) -> None:
    """Write a compact copy of a table."""
    parts = []
    for part in whole.parts.values():
        levels = tuple(
            replace(
                level,
                mixture=compacted(level.mixture[:], level.window),
                log_balance=level.log_balance.astype(np.float16),
            )
            for level in part.levels
        )
        parts.append(replace(part, levels=levels, paths=part.paths.compacted if part.paths else None))
    write_table(path, site=whole.site, scene=whole.scene, parts=parts, software_version=whole.software_version)


def compare_sizes(whole: Table, compact: Table) -> None:
    """Print bytes by array, and times of opening."""
    print("\n| array | MB |\n|---|--:|")
    for table in (whole, compact):
        sizes: dict[str, int] = {}
        for name, array in table.arrays():
            kind = " ".join(name.split("/")[2:]) if name.startswith("stations") else "scene"
            sizes[kind] = sizes.get(kind, 0) + array.nbytes
        for kind, size in sorted(sizes.items(), key=lambda item: -item[1]):
            if size > 1e5:
                print(f"| version {table.format_version}: {kind} | {size / 1e6:.2f} |")
        print(f"| version {table.format_version}: file | {table.path.stat().st_size / 1e6:.1f} |")
    seconds: dict[int, list[float]] = {}
    for table in (whole, compact) * 7:
        begin = time.perf_counter()
        Table.open(table.path)
        seconds.setdefault(table.format_version, []).append(time.perf_counter() - begin)
    print("\nopened in " + ", ".join(f"{np.median(times):.3f} s (version {v})" for v, times in seconds.items()))


def compare_fixes(whole: Table, compact: Table, count: int, seed: int) -> None:
    """Print how far the answers to the same reports move."""
    locators = Locator(whole), Locator(compact)
    drops = [drop for drop in drop_uniformly(whole, count, np.random.default_rng(seed)) if drop.paths]
    print(
        "\n| measured | moved, median, 90 %, most [mm] | of the deviation, median, most | log evidence, median, most "
        "[nats] | error, 50 and 90 % before [m] | after [m] | ms before, after |\n|---|--:|--:|--:|--:|--:|--:|"
    )
    for angles, deg, timing in KINDS:
        rows = np.array(list(_differences(locators, drops, angles, deg, timing, seed)))
        moved, deviation, evidence, before, after, *seconds = rows.T
        fixed = np.isfinite(moved)
        middle, most = np.median(moved[fixed]), moved[fixed].max()
        of = moved[fixed] / deviation[fixed]
        print(
            f"| {angles} {deg:g} deg, {timing} ({np.count_nonzero(fixed)}) "
            f"| {1e3 * middle:.3f}, {1e3 * np.quantile(moved[fixed], 0.9):.3f}, {1e3 * most:.2f} "
            f"| {np.median(of):.1e}, {of.max():.1e} | {np.median(evidence[fixed]):.1e}, {evidence[fixed].max():.1e} "
            f"| {np.quantile(before[fixed], 0.5):.4f}, {np.quantile(before[fixed], 0.9):.4f} "
            f"| {np.quantile(after[fixed], 0.5):.4f}, {np.quantile(after[fixed], 0.9):.4f} "
            f"| {1e3 * np.median(seconds[0]):.2f}, {1e3 * np.median(seconds[1]):.2f} |",
            flush=True,
        )


def _differences(
    locators: tuple[Locator, Locator], drops: list[Drop], angles: str, deg: float, timing: Timing, seed: int
) -> Iterator[list[float]]:
    rng = np.random.default_rng([seed, 1])
    noise = Noise(azimuth_stdev=np.deg2rad(deg), zenith_stdev=np.deg2rad(deg), range_stdev=0.5)
    for drop in drops:
        reported = {name: paths.only(select_path(paths, "strongest", rng)) for name, paths in drop.paths.items()}
        report = simulate_report(reported, noise, rng=rng, timing=timing)
        report["measurements"] = [_of_kind(each, angles) for each in report["measurements"] if _is_kept(each, angles)]
        if not report["measurements"]:
            continue
        fixes, seconds = [], []
        for locator in locators:
            begin = time.perf_counter()
            fixes.append(locator.locate(report))
            seconds.append(time.perf_counter() - begin)
        before, after = fixes
        if before.position is None or after.position is None:
            assert before.status == after.status
            yield [np.nan] * 5 + seconds
            continue
        errors = [float(np.linalg.norm(fix.position - drop.position)) for fix in fixes]
        deviation = float(np.sqrt(np.trace(before.candidates[0].covariance)))
        moved = float(np.linalg.norm(before.position - after.position))
        yield [moved, deviation, abs(before.log_evidence - after.log_evidence), *errors, *seconds]


def _is_kept(measurement: dict[str, Any], angles: str) -> bool:
    return measurement["type"] != "aoa" or angles != "no angle"


def _of_kind(measurement: dict[str, Any], angles: str) -> dict[str, Any]:
    if measurement["type"] == "aoa" and angles == "azimuth":
        return {name: value for name, value in measurement.items() if not name.startswith("zenith")}
    return measurement


if __name__ == "__main__":
    main()
