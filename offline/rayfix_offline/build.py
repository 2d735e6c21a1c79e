"""The offline job: build the table of a site file and its scene.

Finished blocks of cells are saved in shards beside the table, and an interrupted or killed build continues from them.
Stations and cells of a former table that are still valid are taken from there.
"""

import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from rayfix_offline.fit.normalise import balanced, balancing_steps
from rayfix_offline.job.engine import FittingEngine, Job
from rayfix_offline.job.local import LocalEngine
from rayfix_offline.job.method import Method
from rayfix_offline.job.plan import StationPlan, plan_build
from rayfix_offline.job.previous_table import read_former
from rayfix_offline.job.shards import ShardStore
from rayfix_offline.job.station import BuiltStation, StationProgress, build_station, keep_station
from rayfix_offline.rays.lost_rays import LOST_RAYS_WARNING
from rayfix_offline.site import read_site
from rayfix_offline.twin.twin import Twin, prepare_twin, refuse_errors
from rayfix_tables.errors import BuildError
from rayfix_tables.part import StationPart
from rayfix_tables.scene import Scene
from rayfix_tables.version import software_version
from rayfix_tables.write import check_writable, write_table

Progress = Callable[[str, int, int], None]
"""Called with the stage, how much of its work is done, and all of it; 0 while that is unknown.

The work is counted in cells, but in steps while balancing and in bytes while writing. Calls may come from several
threads, one at a time.
"""


@dataclass(frozen=True, kw_only=True)
class StationSummary:
    """Result of a build for one station.

    Attributes
    ----------
    origin : {"built", "resumed", "updated", "kept"}
        Built now; some blocks from shards; some cells from the former table; the whole part from there.
    num_finest_cells : int
        Number of cells of the finest level, which are fitted to rays; the others are sums of them.
    num_kept_cells : int
        Number of finest cells from the former table.
    largest_change : float
        Largest change of the measure of a kept cell, as a fraction of its mass; 0 in an exact table.
    num_dropped_components : int
        Number of components dropped with their weight for want of a positive definite covariance.
    """

    station_id: str
    origin: str
    num_cells: int
    num_filled_cells: int
    num_finest_cells: int
    num_kept_cells: int
    largest_change: float
    num_components: int
    num_dropped_components: int
    num_bytes: int
    lost_ray_share: float
    coverage: tuple[float, ...]
    wall_coverage: tuple[float, ...]
    cut_power_share: float


@dataclass(frozen=True, kw_only=True)
class BuildSummary:
    """Result of a build.

    Attributes
    ----------
    peak_bytes : int
        Peak memory of the process.
    """

    path: Path
    table_id: str
    seconds: float
    num_bytes: int
    peak_bytes: int
    stations: tuple[StationSummary, ...]
    warnings: tuple[str, ...]


def build_table(
    site_path: str | Path,
    table_path: str | Path,
    *,
    jobs: int = -1,
    cluster: str | None = None,
    former: str | Path | None = None,
    tolerance: float = 0.0,
    progress: Progress | None = None,
) -> BuildSummary:
    """Build a site's table, or those parts of it that are missing or have changed.

    Parameters
    ----------
    table_path : str or Path
        Path of the table. A former table there is replaced when the new one is complete.
    jobs : int
        Number of cells that are fitted at a time; -1 for one per core.
    cluster : str, optional
        Address of a Dask scheduler whose workers fit the cells.
    former : str or Path, optional
        Table whose valid parts are reused; by default the one at ``table_path``, if there is one.
    tolerance : float
        Fraction of a cell's mass that may have changed before the cell is fitted again. With 0, the table equals that
        of a new build; otherwise updated stations have a bound on the difference for each of their cells.
    progress : callable, optional
        Called repeatedly.

    Raises
    ------
    SiteError, SceneError
        When the site or its scene cannot be used.
    BuildError
        When the tolerance is not in [0, 1), no ray reaches free space, the cluster fails, or the disk is full. Finished
        blocks remain for the next run.
    TableError
        When ``former`` cannot be read or the table cannot be written. No partial table is left, and a former one is not
        changed.
    """
    begin = time.perf_counter()
    if not 0.0 <= tolerance < 1.0:
        raise BuildError(f"a tolerance of {tolerance:g} is not a fraction of a cell's mass; give 0 or more, below 1")
    report = progress or (lambda stage, done, total: None)
    site_path, table_path = Path(site_path), Path(table_path)
    site = read_site(site_path)
    check_writable(table_path)
    report("reading the scene", 0, 0)
    method = Method()
    twin = prepare_twin(site, site_path.parent, method.twin)
    refuse_errors(twin)
    plans = plan_build(twin.site, twin, method)
    refused: list[str] = []
    former_table = read_former(
        Path(former) if former is not None else table_path,
        method,
        required=former is not None,
        refused=refused.append,
    )
    with closing(ShardStore.beside(table_path)) as store:
        job = Job(
            site=twin.site, twin=twin, method=method, store=store, jobs=jobs, former=former_table, tolerance=tolerance
        )
        built = _build_stations(plans, job, cluster, report)
        built = _balanced(built, job, report)
        parts = [
            replace(station.part, station=given) for station, given in zip(built, site.info().stations, strict=True)
        ]
        if not any(len(level.mixture) for part in parts for level in part.levels):
            raise BuildError("no ray of any station finds free space; check the stations' positions and fields of view")
        table_id = write_table(
            table_path,
            site=site.info(),
            scene=_scene_of(twin),
            parts=parts,
            software_version=software_version(),
            progress=partial(report, "writing"),
        )
        store.remove()
    stations = tuple(_summary(plan.station.id, station) for plan, station in zip(plans, built, strict=True))
    return BuildSummary(
        path=table_path,
        table_id=table_id,
        seconds=time.perf_counter() - begin,
        num_bytes=table_path.stat().st_size,
        peak_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        stations=stations,
        warnings=(
            *refused,
            *(finding.message for finding in twin.findings),
            *_lost_ray_warnings(plans, parts, twin),
            *_dropped_warnings(stations),
        ),
    )


def _build_stations(
    plans: tuple[StationPlan, ...], job: Job, cluster: str | None, report: Progress
) -> list[BuiltStation]:
    """Take over or build the parts of all stations; the engine and its rays are released with the return."""
    total = sum(plan.num_cells for plan in plans)
    done = 0
    built: list[BuiltStation] = []
    with ExitStack() as stack:
        engine: FittingEngine | None = None
        for plan in plans:
            station = keep_station(plan, job)
            if station is None:
                engine = engine or stack.enter_context(_start_engine(cluster, job))
                station = build_station(plan, job, engine, _after(done, total, report))
            built.append(station)
            done += plan.num_cells
    return built


def _balanced(stations: list[BuiltStation], job: Job, report: Progress) -> list[BuiltStation]:
    """Normalise all levels, if the path prior is one whose probabilities add up to 1 at each position.

    A part that was kept as a whole belongs to the same free space, so that it remains valid.
    """
    if job.site.propagation.path_prior != "power":
        return stations
    levels = [level for station in stations if not _keeps_balance(station) for level in station.part.levels]
    advance = _Counter("balancing", sum(balancing_steps(level, job.method.balance) for level in levels), report)
    tasks = (
        delayed(balanced)(level, job.twin.free_space, job.method.balance, advance=advance.advance) for level in levels
    )
    done = iter(Parallel(n_jobs=job.jobs, prefer="threads")(tasks))
    return [
        station
        if _keeps_balance(station)
        else replace(station, part=replace(station.part, levels=tuple(next(done) for _ in station.part.levels)))
        for station in stations
    ]


class _Counter:
    """Progress of a stage to which several threads contribute."""

    def __init__(self, stage: str, total: int, report: Progress) -> None:
        self._stage, self._total, self._report = stage, total, report
        self._done = 0
        self._lock = threading.Lock()
        if total:
            report(stage, 0, total)

    def advance(self, steps: int) -> None:
        """Count and report steps that were taken."""
        with self._lock:
            self._done += steps
            self._report(self._stage, self._done, self._total)


def _keeps_balance(station: BuiltStation) -> bool:
    """Whether a station's part is taken from a former table that is normalised; those of early versions are not."""
    levels = station.part.levels
    return station.origin == "kept" and all(len(level.log_balance) == len(level.mixture) for level in levels)


def _start_engine(cluster: str | None, job: Job) -> AbstractContextManager[FittingEngine]:
    """Return the local engine, or connect to a cluster; only that needs Dask."""
    if cluster is None:
        return nullcontext(LocalEngine(job))
    try:
        from rayfix_offline.job.cluster import Cluster
    except ModuleNotFoundError as error:
        raise BuildError(
            f"the module '{error.name}' is not installed; install it with: pip install 'rayfix[cluster]'"
        ) from error
    return Cluster(cluster, job)


def _lost_ray_warnings(plans: tuple[StationPlan, ...], parts: list[StationPart], twin: Twin) -> Iterator[str]:
    for plan, part in zip(plans, parts, strict=True):
        if twin.closed and part.lost_ray_share > LOST_RAYS_WARNING:
            yield (
                f"{part.lost_ray_share:.1%} of the rays of station '{plan.station.id}' leave the closed scene; it "
                "has holes: close them"
            )


def _dropped_warnings(stations: tuple[StationSummary, ...]) -> Iterator[str]:
    for station in stations:
        if station.num_dropped_components:
            yield (
                f"{station.num_dropped_components} components of station '{station.station_id}' have no positive "
                "definite covariance and are dropped with their weight; their paths have very small probabilities: "
                "lower path_prior_exponent if they matter"
            )


def _scene_of(twin: Twin) -> Scene:
    return Scene(
        vertices=twin.scene.vertices,
        faces=twin.scene.faces,
        face_materials=twin.scene.face_materials,
        materials=twin.scene.materials,
        free_space=twin.free_space,
        sha256=twin.scene.sha256,
        face_thickness=twin.scene.face_thickness,
    ).moved(twin.origin)


def _summary(station_id: str, built: BuiltStation) -> StationSummary:
    part = built.part
    return StationSummary(
        station_id=station_id,
        origin=built.origin,
        num_cells=sum(level.grid.num_cells for level in part.levels),
        num_filled_cells=sum(int(np.isfinite(level.cell_log_mass).sum()) for level in part.levels),
        num_finest_cells=part.levels[0].num_cells,
        num_kept_cells=built.num_kept_cells,
        largest_change=part.update.largest_change if part.update else 0.0,
        num_components=sum(len(level.mixture) for level in part.levels),
        num_dropped_components=built.num_dropped,
        num_bytes=part.num_bytes,
        lost_ray_share=part.lost_ray_share,
        coverage=part.coverage,
        wall_coverage=part.wall_coverage,
        cut_power_share=part.cut_power_share,
    )


def _after(before: int, total: int, report: Progress) -> StationProgress:
    """Return the progress callback of a station that follows this many cells."""
    return lambda stage, done: report(stage, before + done, total)
