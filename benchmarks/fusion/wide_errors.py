"""Fixes of angles with wide errors beside the exact posterior of the same model on a dense grid.

Two scenes of 8 x 18 x 2.5 m with four stations: the hall, and an empty box without reflections. The exact posterior is
the product of the same likelihoods at the points of a grid, with the paths of the forward solver and the path prior's
weights. For each row: ``near`` is the percentage of fixes whose position is within 0.15 standard deviations of the
exact mean, and ``ambiguous`` that of fixes with this status, both of the reports whose exact posterior has one mode;
``held`` is how many true positions the 90 % regions hold, per cent; ``nats`` is the median error of the log evidence;
``ms`` is the median processor time of a fix.
"""

import argparse
import itertools
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy import ndimage

from rayfix.example.files import write_example
from rayfix_evaluation.drops.accuracy import drop_positions, solver_of
from rayfix_evaluation.drops.simulate import fold_direction
from rayfix_evaluation.truth.forward import ForwardSolver
from rayfix_offline.build import build_table
from rayfix_service.fusion.measurements.report import GAUSSIAN, Angle, ErrorModel, Height, Report
from rayfix_service.locator import Locator
from rayfix_tables.table import Table

DEGREES = (2.0, 5.0, 10.0, 15.0, 20.0)
KINDS = ("both", "azimuth", "height", "tails")
"""Azimuth and elevation; azimuth alone; azimuth and a known height; azimuth and elevation with heavy tails."""

TAILS = ErrorModel(tail_share=0.2, tail_scale=3.0)
HEIGHT_STDEV = 0.1  # m
OUTLIER = 0.01
LEAST_SHARE = 1e-3

BOX = """
[site]
name = "box"
scene = "box.ply"
[propagation]
max_reflections = 0
[table]
windows_deg = [1.25, 5, 15]
"""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Exact:
    """Paths of the forward solver to the points of a grid.

    Attributes
    ----------
    points : ndarray of shape (n, 3), m
    cells : ndarray of int, shape (n, 3)
        Coordinates on the grid.
    spacing : ndarray of shape (3,), m
    paths : dict of str to tuple
        For each station the first path of each point, and azimuth, zenith and weight of all paths.
    """

    points: Array
    cells: NDArray[np.int64]
    spacing: Array
    paths: dict[str, tuple[NDArray[np.int64], Array, Array, Array]]

    def log_posterior(self, report: Report) -> Array:
        """Natural logarithm of prior times likelihood, integrated over the cell of each point."""
        log = np.zeros(len(self.points))
        for angle in report.measurements:
            assert isinstance(angle, Angle)
            offsets, azimuth, zenith, weight = self.paths[angle.station_id]
            density = weight * self._density(angle, azimuth, zenith)
            summed = np.add.reduceat(np.append(density, 0.0), offsets[:-1])
            summed[np.diff(offsets) == 0] = 0.0
            any_direction = 4.0 * np.pi if angle.zenith is not None else 2.0 * np.pi
            log += np.log((1.0 - OUTLIER) * summed + OUTLIER / any_direction)
        if report.height is not None:
            log += -0.5 * ((self.points[:, 2] - report.height.z) / report.height.stdev) ** 2
            volume = np.exp(-0.5 * ((self.points[:, 2] - report.height.z) / report.height.stdev) ** 2).sum()
            return np.asarray(log - np.log(volume))
        return np.asarray(log - np.log(len(self.points)))

    @staticmethod
    def _density(angle: Angle, azimuth: Array, zenith: Array) -> Array:
        model = angle.error_model
        aside = np.angle(np.exp(1j * (azimuth - angle.azimuth)))
        total = np.zeros(len(azimuth))
        for share, scale in ((1.0 - model.tail_share, 1.0), (model.tail_share, model.tail_scale)):
            wide = scale * angle.azimuth_stdev
            density = np.exp(-0.5 * (aside / wide) ** 2) / (np.sqrt(2.0 * np.pi) * wide)
            if angle.zenith is not None and angle.zenith_stdev is not None:
                high = scale * angle.zenith_stdev
                density *= np.exp(-0.5 * ((zenith - angle.zenith) / high) ** 2) / (np.sqrt(2.0 * np.pi) * high)
                density /= np.sin(angle.zenith)
            total += share * density
        return total

    def num_modes(self, log: Array) -> int:
        """Count the places with a hundredth of the posterior whose density falls to half of their peak on any way."""
        shape = self.cells.max(axis=0) + 1
        grid = np.full(shape, -np.inf)
        grid[tuple(self.cells.T)] = log
        # A wall of one cell does not divide a place.
        filled = ndimage.maximum_filter(grid, size=3)
        grid = np.where(np.isinf(grid), filled - 1e-9, grid)
        share = np.where(np.isfinite(grid), np.exp(grid - np.logaddexp.reduce(log)), 0.0)
        peaks: list[tuple[int, ...]] = []
        low, high = self.cells[log > log.max() - 9.0].min(axis=0), self.cells[log > log.max() - 9.0].max(axis=0) + 1
        grid, share = (each[tuple(map(slice, low, high))] for each in (grid, share))
        for level in np.arange(grid.max() - 0.1, grid.max() - 6.0, -0.3):
            labels, count = ndimage.label(grid >= level, np.ones((3, 3, 3)))
            tops = ndimage.maximum_position(grid, labels, range(1, count + 1))
            heights = ndimage.maximum(grid, labels, range(1, count + 1))
            masses = ndimage.sum_labels(share, labels, range(1, count + 1))
            for top, height, mass in zip(tops, heights, masses, strict=True):
                if height - level >= np.log(2.0) and mass > 0.01 and top not in peaks:
                    peaks.append(top)
        return max(1, len(peaks))


def exact_paths(table: Table, spacing: float) -> Exact:
    """Solve for the paths to the points of a grid in the free space."""
    space = table.scene.free_space
    # Known heights need thin layers.
    side = np.array([max(1, round(spacing / space.voxel_size))] * 2 + [1])
    shape = np.array(space.free.shape) // side
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    points = space.origin + space.voxel_size * side * (index + 0.5)
    free = space.contains(points)
    points, index = points[free], index[free]
    solver = solver_of(table)
    exponent = table.site.document["propagation"]["path_prior_exponent"]
    found = {}
    for station in table.site.stations:
        parts = Parallel(n_jobs=-1)(
            delayed(_paths)(solver, np.array(station.position), chunk, exponent)
            for chunk in np.array_split(points, max(1, len(points) // 2000))
        )
        counts, azimuth, zenith, weight = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        found[station.id] = (np.concatenate([[0], np.cumsum(counts)]), azimuth, zenith, weight)
    return Exact(points=points, cells=index, spacing=space.voxel_size * side, paths=found)


def _paths(solver: ForwardSolver, station: Array, points: Array, exponent: float) -> tuple[Array, ...]:
    of_station = solver.station(station)
    counts, columns = [], []
    for point in points:
        paths = of_station.paths(point)
        weight = 10.0 ** (0.1 * exponent * paths.gain_db)
        weight = weight / weight.sum() if len(weight) else weight
        kept = weight > LEAST_SHARE
        counts.append(np.count_nonzero(kept))
        columns.append(np.stack([paths.azimuth[kept], paths.zenith[kept], weight[kept]]))
    return np.array(counts), *np.concatenate(columns, axis=1)


def reports(
    table: Table, degrees: float, kind: str, stations: int, count: int, seed: int
) -> Iterator[tuple[Array, Report]]:
    """Draw places, and angles of the strongest paths to them with noise of the stated kind."""
    solver, stdev = solver_of(table), float(np.deg2rad(degrees))
    solvers = {each.id: solver.station(np.array(each.position)) for each in table.site.stations[:stations]}
    rng = np.random.default_rng([seed, int(10 * degrees), KINDS.index(kind), stations])
    for place in drop_positions(table, count, rng):
        measurements = []
        for name, solved in solvers.items():
            paths = solved.paths(place)
            scale = 3.0 if kind == "tails" and rng.random() < TAILS.tail_share else 1.0
            errors = scale * stdev * rng.standard_normal(2)
            if not len(paths):
                continue
            n = int(np.argmax(paths.gain_db))
            azimuth, zenith = fold_direction(paths.azimuth[n] + errors[0], paths.zenith[n] + errors[1])
            angle = Angle(station_id=name, azimuth=azimuth, zenith=zenith, azimuth_stdev=stdev, zenith_stdev=stdev)
            if kind in ("azimuth", "height"):
                azimuth = fold_direction(paths.azimuth[n] + errors[0], 1.0)[0]
                angle = replace(angle, azimuth=azimuth, zenith=None, zenith_stdev=None)
            measurements.append(replace(angle, error_model=TAILS if kind == "tails" else GAUSSIAN))
        if measurements:
            height = None
            if kind == "height":
                height = Height(z=float(place[2] + HEIGHT_STDEV * rng.standard_normal()), stdev=HEIGHT_STDEV)
            yield place, Report(measurements=tuple(measurements), height=height)


def row(locator: Locator, exact: Exact, drawn: list[tuple[Array, Report]]) -> str:
    near, ambiguous, held, nats, seconds, single, statuses = [], [], [], [], [], 0, []
    for place, report in drawn:
        begin = time.thread_time()
        fix = locator.locate(report)
        seconds.append(time.thread_time() - begin)
        log = exact.log_posterior(report)
        log_evidence = float(np.logaddexp.reduce(log))
        nats.append(abs(fix.log_evidence - log_evidence))
        statuses.append(fix.status)
        held.append(fix.regions is not None and fix.regions.ellipsoid(0.9).holds(place))
        if exact.num_modes(log) > 1:
            continue
        single += 1
        share = np.exp(log - log_evidence)
        mean = share @ exact.points
        apart = exact.points - mean
        cov = np.einsum("n,ni,nj->ij", share, apart, apart) + np.diag(exact.spacing**2 / 12.0)
        ambiguous.append(fix.status == "ambiguous")
        off = np.full(3, np.inf) if fix.position is None else fix.position - mean
        near.append(bool(np.all(np.isfinite(off))) and float(off @ np.linalg.solve(cov, off)) <= 0.15**2)
    return (
        f"near {100 * np.mean(near):5.1f}  ambiguous {100 * np.mean(ambiguous):5.1f}  held {100 * np.mean(held):5.1f}  "
        f"nats {np.median(nats):.3f}  ms {1e3 * np.median(seconds):6.2f}  of one mode {single} of {len(drawn)}"
    )


def write_box(folder: Path) -> Path:
    """Write a site of the hall's outer walls alone, without reflections."""
    import trimesh

    write_example(folder)
    box = trimesh.creation.box(bounds=[[0, 0, 0], [8, 18, 2.5]])
    box.export(folder / "box.ply")
    corners = [(0.1, 0.1), (7.9, 0.1), (7.9, 17.9), (0.1, 17.9)]
    stations = [f'[[stations]]\nid = "bs{n + 1}"\nposition_m = [{x}, {y}, 2.4]\n' for n, (x, y) in enumerate(corners)]
    (folder / "box.toml").write_text(BOX + "".join(stations))
    return folder / "box.toml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=("box", "hall"), action="append")
    parser.add_argument("--table", type=Path, help="of the scene, which must be one; built when left out")
    parser.add_argument("--degrees", type=float, action="append")
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--stations", type=int, action="append")
    parser.add_argument("--reports", type=int, default=300)
    parser.add_argument("--spacing", type=float, default=0.2, help="of the exact posterior's grid along x and y, m")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--gaussians", action="store_true", help="without the path map, as tables had none")
    options = parser.parse_args()
    rows = list(itertools.product(options.degrees or DEGREES, options.kind or KINDS, options.stations or (1, 2, 3, 4)))
    for scene in options.scene or ("box", "hall"):
        with tempfile.TemporaryDirectory() as folder:
            path = options.table
            if path is None:
                path = Path(folder) / "table.h5"
                build_table(write_box(Path(folder)) if scene == "box" else write_example(folder), path)
            table = Table.open(path)
            if options.gaussians:
                table = replace(table, parts={name: replace(part, paths=None) for name, part in table.parts.items()})
            exact = exact_paths(table, options.spacing)
            print(f"{scene}: {len(exact.points)} points", flush=True)
            locator = Locator(table)
            locator.warm_up()
            for degrees, kind, stations in rows:
                drawn = list(reports(table, degrees, kind, stations, options.reports, options.seed))
                print(
                    f"{scene} {degrees:4g} deg  {kind:8s} {stations} stations: {row(locator, exact, drawn)}", flush=True
                )


if __name__ == "__main__":
    main()
