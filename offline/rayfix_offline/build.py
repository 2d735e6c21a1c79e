"""The offline job: a site file and its scene become a table.

Finished blocks of cells go to shards beside the table to be, so that a build that was interrupted or killed goes on
where it was; a station whose part of the table at the same place is still right is taken from there.
"""

import resource
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from joblib import Parallel, delayed

from rayfix_offline.cells import FittedCells, assemble_level, fit_cells
from rayfix_offline.plan import Block, StationPlan, plan_build
from rayfix_offline.shards import ShardStore
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.trace import StationTrace, level_grid, trace_station
from rayfix_offline.twin import Twin, prepare_twin, refuse_errors
from rayfix_tables.errors import BuildError, TableError
from rayfix_tables.table import StationPart, Table
from rayfix_tables.version import software_version
from rayfix_tables.write import SceneContent, StationContent, check_writable, write_table

if TYPE_CHECKING:
    from rayfix_offline.cluster import Cluster

LOST_RAYS_WARNING = 0.01
"""In a closed scene, more lost rays than this share mean that it has holes."""

Progress = Callable[[str, int, int], None]
"""Called with the stage, the cells that are done and the cells that there are in all (0 while not yet known)."""


@dataclass(frozen=True, kw_only=True)
class StationSummary:
    """What the build made of one station.

    Attributes
    ----------
    origin : str
        "built", "resumed" (some blocks came from shards) or "kept" (the whole part came from the former table).
    """

    station_id: str
    origin: str
    num_cells: int
    num_filled_cells: int
    num_components: int
    num_bytes: int
    lost_ray_share: float
    coverage: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class BuildSummary:
    """What the build made.

    Attributes
    ----------
    peak_bytes : int
        Most memory that the process has held.
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
    progress: Progress | None = None,
) -> BuildSummary:
    """Build a site's table, or what of it is missing or has changed.

    Parameters
    ----------
    table_path : str or Path
        Where the table goes. A former table there is replaced when the new one is whole.
    jobs : int
        Cells that are fitted at a time; -1 for one per core.
    cluster : str, optional
        Address of a Dask scheduler, whose workers then fit the cells.
    progress : callable, optional
        Called as the build goes on.

    Raises
    ------
    SiteError, SceneError
        When the site or its scene cannot be used.
    BuildError
        When no ray finds anything, the cluster fails, or the disk is full; finished blocks stay for the next run.
    TableError
        When the table cannot be written. No partial table is left, and a former one stays as it was.
    """
    begin = time.perf_counter()
    report = progress or (lambda stage, done, total: None)
    site_path, table_path = Path(site_path), Path(table_path)
    site = read_site(site_path)
    check_writable(table_path)
    report("reading the scene", 0, 0)
    twin = prepare_twin(site, site_path.parent)
    refuse_errors(twin)
    plans = plan_build(site, twin)
    former = _reusable_parts(table_path, {plan.part_id for plan in plans})
    store = ShardStore.beside(table_path)
    total = sum(plan.num_cells for plan in plans)
    done = 0
    contents: list[StationContent] = []
    origins: list[str] = []
    with ExitStack() as stack:
        remote: Cluster | None = None
        for plan in plans:
            if plan.part_id in former:
                contents.append(_kept_content(former[plan.part_id]))
                origins.append("kept")
            else:
                if cluster is not None and remote is None:
                    remote = stack.enter_context(_connect(cluster, site, twin))
                content, resumed = _build_station(plan, site, twin, store, jobs, remote, _Shifted(report, done, total))
                contents.append(content)
                origins.append("resumed" if resumed else "built")
            done += plan.num_cells
    if not any(len(level.mixture) for content in contents for level in content.levels):
        raise BuildError("no ray of any station finds free space; check the stations' positions and fields of view")
    report("writing", done, total)
    table_id = write_table(
        table_path,
        site=site.info(),
        scene=_scene_content(twin),
        stations=contents,
        software_version=software_version(),
    )
    store.remove()
    return BuildSummary(
        path=table_path,
        table_id=table_id,
        seconds=time.perf_counter() - begin,
        num_bytes=table_path.stat().st_size,
        peak_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        stations=tuple(
            _summary(plan.station.id, origin, content)
            for plan, origin, content in zip(plans, origins, contents, strict=True)
        ),
        warnings=(*(finding.message for finding in twin.findings), *_lost_ray_warnings(plans, contents, twin)),
    )


@dataclass(frozen=True)
class _Shifted:
    """Progress of a part of the work."""

    report: Progress
    before: int
    total: int

    def __call__(self, stage: str, done: int) -> None:
        self.report(stage, self.before + done, self.total)


def _build_station(
    plan: StationPlan,
    site: SiteFile,
    twin: Twin,
    store: ShardStore,
    jobs: int,
    remote: "Cluster | None",
    report: _Shifted,
) -> tuple[StationContent, bool]:
    """Build a station's part, and tell whether some of it came from shards."""
    station_id = plan.station.id
    windows = np.deg2rad(site.table.windows_deg)
    launch = store.load(f"{plan.part_id}-launch")
    parts: dict[tuple[int, int], FittedCells] = {}
    for block in plan.blocks:
        arrays = store.load(f"{plan.part_id}-{block.shard}")
        if arrays is not None:
            parts[block.level, block.number] = FittedCells.from_arrays(arrays)
    resumed = bool(parts)
    missing = [block for block in plan.blocks if (block.level, block.number) not in parts]
    done = plan.num_cells - sum(len(block.cells) for block in missing)
    if missing or launch is None:
        report(f"{station_id}: tracing rays", done)
        if remote is None:
            trace = trace_station(plan.section, site, twin)
            launch, fitting = trace.to_arrays(), _fit_blocks(missing, trace, site, jobs)
        else:
            launch, fitting = remote.launch(plan), remote.fit_blocks(plan, missing)
        store.save(f"{plan.part_id}-launch", launch)
        for block, fitted in fitting:
            store.save(f"{plan.part_id}-{block.shard}", fitted.to_arrays())
            parts[block.level, block.number] = fitted
            done += len(block.cells)
            report(f"{station_id}: {np.rad2deg(windows[block.level]):g} deg cells", done)
    levels = tuple(
        assemble_level(float(window), level_grid(float(window)), [parts[key] for key in sorted(parts) if key[0] == n])
        for n, window in enumerate(windows)
    )
    content = StationContent(
        part_id=plan.part_id,
        levels=levels,
        lost_ray_share=float(launch["lost_ray_share"]),
        coverage=tuple(float(share) for share in launch["coverage"]),
    )
    return content, resumed


def _connect(address: str, site: SiteFile, twin: Twin) -> "Cluster":
    """Connect to a cluster; only this needs Dask."""
    try:
        from rayfix_offline.cluster import Cluster
    except ModuleNotFoundError as error:
        raise BuildError(
            f"the module '{error.name}' is not installed; install it with: pip install 'rayfix[cluster]'"
        ) from error
    return Cluster(address, site, twin.scene)


def _fit_blocks(
    blocks: list[Block], trace: StationTrace, site: SiteFile, jobs: int
) -> Iterator[tuple[Block, FittedCells]]:
    """Fit blocks in parallel; they come back in their order."""
    tasks = (delayed(fit_cells)(block.cells, trace.levels[block.level], site) for block in blocks)
    # The compiled kernels release the interpreter's lock, so threads share the rays without a copy; scikit-learn
    # holds it, so its fits need processes.
    prefer = "processes" if site.table.fit == "em" else "threads"
    results = Parallel(n_jobs=jobs, prefer=prefer, return_as="generator")(tasks)
    try:
        yield from zip(blocks, results, strict=True)
    finally:
        with warnings.catch_warnings():
            # An interrupted build gives tasks up on purpose; joblib need not warn of it.
            warnings.simplefilter("ignore", UserWarning)
            results.close()


def _reusable_parts(table_path: Path, wanted: set[str]) -> dict[str, StationPart]:
    """Parts of a former table under the same name that are still right, by their ids."""
    if not table_path.exists():
        return {}
    try:
        table = Table.open(table_path)
        found = {part.part_id: part for part in table.parts.values() if part.part_id in wanted}
        if found:
            table.verify()
    except TableError:
        return {}  # whatever lies there is replaced
    return found


def _kept_content(part: StationPart) -> StationContent:
    return StationContent(
        part_id=part.part_id,
        levels=part.levels,
        lost_ray_share=part.lost_ray_share,
        coverage=part.coverage,
    )


def _lost_ray_warnings(plans: tuple[StationPlan, ...], contents: list[StationContent], twin: Twin) -> Iterator[str]:
    for plan, content in zip(plans, contents, strict=True):
        if twin.closed and content.lost_ray_share > LOST_RAYS_WARNING:
            yield (
                f"{content.lost_ray_share:.1%} of the rays of station '{plan.station.id}' leave the closed scene; it "
                "has holes: close them"
            )


def _scene_content(twin: Twin) -> SceneContent:
    return SceneContent(
        vertices=twin.scene.vertices,
        faces=twin.scene.faces,
        face_materials=twin.scene.face_materials,
        materials=twin.scene.materials,
        free_space=twin.free_space,
        sha256=twin.scene.sha256,
    )


def _summary(station_id: str, origin: str, content: StationContent) -> StationSummary:
    return StationSummary(
        station_id=station_id,
        origin=origin,
        num_cells=sum(level.grid.num_cells for level in content.levels),
        num_filled_cells=sum(int(np.isfinite(level.cell_log_mass).sum()) for level in content.levels),
        num_components=sum(len(level.mixture) for level in content.levels),
        num_bytes=sum(level.num_bytes for level in content.levels),
        lost_ray_share=content.lost_ray_share,
        coverage=content.coverage,
    )
