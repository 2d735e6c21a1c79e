"""The offline job: a site file and its scene become a table."""

import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from warnings import catch_warnings, simplefilter

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from rayfix_offline.em import ExpectationMaximisation, fit_em
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.trace import LevelRays, level_grid, trace_station
from rayfix_offline.tubes import TubeFit, fit_tubes
from rayfix_offline.twin import Twin, prepare_twin, refuse_errors
from rayfix_tables.angles import direction, local_to_scene
from rayfix_tables.errors import BuildError
from rayfix_tables.mixture import TubeMixture
from rayfix_tables.site import Station
from rayfix_tables.version import software_version
from rayfix_tables.write import LevelContent, SceneContent, StationContent, check_writable, write_table

BLOCK_CELLS = 256
"""Cells that one task fits."""

LOST_RAYS_WARNING = 0.01
"""In a closed scene, more lost rays than this share mean that it has holes."""

FittedCells = tuple[NDArray[np.int64], NDArray[np.float64], TubeMixture]
"""Components of each cell, log mass of each cell, components of all cells."""

Progress = Callable[[str, int, int], None]
"""Called with the stage, the cells that are done and the cells that there are in all (0 while not yet known)."""


@dataclass(frozen=True, kw_only=True)
class StationSummary:
    """What the build made of one station."""

    station_id: str
    num_cells: int
    num_filled_cells: int
    num_components: int
    num_bytes: int
    lost_ray_share: float
    coverage: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class BuildSummary:
    """What the build made."""

    path: Path
    table_id: str
    seconds: float
    num_bytes: int
    stations: tuple[StationSummary, ...]
    warnings: tuple[str, ...]


def build_table(
    site_path: str | Path, table_path: str | Path, *, jobs: int = -1, progress: Progress | None = None
) -> BuildSummary:
    """Build a site's table.

    Parameters
    ----------
    jobs : int
        Cells that are fitted at a time; -1 for one per core.
    progress : callable, optional
        Called as the build goes on.

    Raises
    ------
    SiteError, SceneError
        When the site or its scene cannot be used.
    BuildError
        When no ray finds anything.
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
    info = site.info()
    warnings = [finding.message for finding in twin.findings]
    views = [_cells_in_view(station, site) for station in info.stations]
    total = sum(len(cells) for view in views for cells in view)
    done = 0
    contents: list[StationContent] = []
    for section, station, view in zip(site.stations, info.stations, views, strict=True):
        report(f"{station.id}: tracing rays", done, total)
        trace = trace_station(section, site, twin)
        if twin.closed and trace.lost_ray_share > LOST_RAYS_WARNING:
            warnings.append(
                f"{trace.lost_ray_share:.1%} of the rays of station '{station.id}' leave the closed scene; it has "
                "holes: close them"
            )
        levels = []
        for level, cells in zip(trace.levels, view, strict=True):
            stage = f"{station.id}: {np.rad2deg(level.window):g} deg cells"
            parts = []
            with closing(_fit_blocks(cells, level, site, jobs)) as blocks:
                for block, fitted in blocks:
                    parts.append((block, fitted))
                    done += len(block)
                    report(stage, done, total)
            levels.append(_level_content(level, parts))
        contents.append(
            StationContent(levels=tuple(levels), lost_ray_share=trace.lost_ray_share, coverage=trace.coverage)
        )
    if not any(len(level.mixture) for content in contents for level in content.levels):
        raise BuildError("no ray of any station finds free space; check the stations' positions and fields of view")
    report("writing", done, total)
    table_id = write_table(
        table_path,
        site=info,
        scene=_scene_content(twin),
        stations=contents,
        software_version=software_version(),
    )
    return BuildSummary(
        path=table_path,
        table_id=table_id,
        seconds=time.perf_counter() - begin,
        num_bytes=table_path.stat().st_size,
        stations=tuple(_summary(s.id, c) for s, c in zip(info.stations, contents, strict=True)),
        warnings=tuple(warnings),
    )


def _cells_in_view(station: Station, site: SiteFile) -> list[NDArray[np.int64]]:
    """Cells of each level whose centre lies in the station's field of view or hardly outside."""
    axis = local_to_scene(station.orientation)[:, 0]
    found = []
    for window in np.deg2rad(site.table.windows_deg):
        centres = level_grid(float(window)).centres
        angle = np.arccos(np.clip(direction(centres[:, 0], centres[:, 1]) @ axis, -1.0, 1.0))
        found.append(np.flatnonzero(angle <= 0.5 * station.field_of_view + window))
    return found


def _fit_blocks(
    cells: NDArray[np.int64], level: LevelRays, site: SiteFile, jobs: int
) -> Generator[tuple[NDArray[np.int64], FittedCells], None, None]:
    """Fit the cells of a level in parallel, block by block, in their order."""
    blocks = [cells[i : i + BLOCK_CELLS] for i in range(0, len(cells), BLOCK_CELLS)]
    centres = level.grid.centres
    if site.table.fit == "em":
        # scikit-learn holds the interpreter's lock, so its fits need processes.
        settings = ExpectationMaximisation(seed=site.table.seed)
        tasks = (delayed(fit_em)(centres[b], b, level, settings) for b in blocks)
        results = Parallel(n_jobs=jobs, return_as="generator")(tasks)
    else:
        # The compiled kernels release the lock, so threads share the rays without a copy.
        tasks = (delayed(fit_tubes)(centres[b], level, TubeFit()) for b in blocks)
        results = Parallel(n_jobs=jobs, prefer="threads", return_as="generator")(tasks)
    try:
        yield from zip(blocks, results, strict=True)
    finally:
        # After Ctrl-C joblib warns that tasks are cancelled, which is as it should be.
        with catch_warnings():
            simplefilter("ignore", UserWarning)
            results.close()


def _level_content(level: LevelRays, parts: list[tuple[NDArray[np.int64], FittedCells]]) -> LevelContent:
    """Put fitted blocks of cells together."""
    counts = np.zeros(level.grid.num_cells, np.int64)
    log_mass = np.full(level.grid.num_cells, -np.inf)
    for block, (block_counts, block_mass, _) in parts:
        counts[block], log_mass[block] = block_counts, block_mass
    return LevelContent(
        window=level.window,
        grid=level.grid,
        cell_offsets=np.concatenate([[0], np.cumsum(counts)]),
        cell_log_mass=log_mass,
        mixture=TubeMixture.concatenate([mixture for _, (_, _, mixture) in parts]),
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


def _summary(station_id: str, content: StationContent) -> StationSummary:
    return StationSummary(
        station_id=station_id,
        num_cells=sum(level.grid.num_cells for level in content.levels),
        num_filled_cells=sum(int(np.isfinite(level.cell_log_mass).sum()) for level in content.levels),
        num_components=sum(len(level.mixture) for level in content.levels),
        num_bytes=sum(level.num_bytes for level in content.levels),
        lost_ray_share=content.lost_ray_share,
        coverage=content.coverage,
    )
