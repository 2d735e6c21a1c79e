"""The offline job: a site file and its scene become a table."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from rayfix_offline.em import ExpectationMaximisation, fit_em
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.trace import LevelRays, trace_station
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

Progress = Callable[[str, int, int], None]
"""Called with the stage, the cells that are done and the cells that there are."""


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
    report("reading the scene", 0, 1)
    twin = prepare_twin(site, site_path.parent)
    refuse_errors(twin)
    info = site.info()
    warnings = [finding.message for finding in twin.findings]
    contents: list[StationContent] = []
    for number, (section, station) in enumerate(zip(site.stations, info.stations, strict=True)):
        report(f"{station.id}: tracing", number, len(site.stations))
        trace = trace_station(section, site, twin)
        if twin.closed and trace.lost_ray_share > LOST_RAYS_WARNING:
            warnings.append(
                f"{trace.lost_ray_share:.1%} of the rays of station '{station.id}' leave the closed scene; it has "
                "holes: close them"
            )
        levels = tuple(_build_level(level, station, site, jobs, report) for level in trace.levels)
        contents.append(
            StationContent(levels=levels, lost_ray_share=trace.lost_ray_share, coverage=trace.coverage)
        )
    if not any(len(level.mixture) for content in contents for level in content.levels):
        raise BuildError("no ray of any station finds free space; check the stations' positions and fields of view")
    report("writing", 0, 1)
    table_id = write_table(
        table_path, site=info, scene=_scene_content(twin), stations=contents, software_version=software_version()
    )
    report("writing", 1, 1)
    return BuildSummary(
        path=table_path,
        table_id=table_id,
        seconds=time.perf_counter() - begin,
        num_bytes=table_path.stat().st_size,
        stations=tuple(_summary(s.id, c) for s, c in zip(info.stations, contents, strict=True)),
        warnings=tuple(warnings),
    )


def _build_level(level: LevelRays, station: Station, site: SiteFile, jobs: int, report: Progress) -> LevelContent:
    chosen = np.flatnonzero(_in_view(level.grid.centres, station, margin=level.window))
    blocks = np.split(chosen, np.arange(BLOCK_CELLS, len(chosen), BLOCK_CELLS))
    counts = np.zeros(level.grid.num_cells, np.int64)
    log_mass = np.full(level.grid.num_cells, -np.inf)
    parts: list[TubeMixture] = []
    stage = f"{station.id}: {np.rad2deg(level.window):g} deg cells"
    done = 0
    report(stage, done, len(chosen))
    for block, (block_counts, block_mass, mixture) in zip(blocks, _fit_blocks(blocks, level, site, jobs), strict=True):
        counts[block], log_mass[block] = block_counts, block_mass
        parts.append(mixture)
        done += len(block)
        report(stage, done, len(chosen))
    return LevelContent(
        window=level.window,
        grid=level.grid,
        cell_offsets=np.concatenate([[0], np.cumsum(counts)]),
        cell_log_mass=log_mass,
        mixture=TubeMixture.concatenate(parts),
    )


def _fit_blocks(
    blocks: list[NDArray[np.int64]], level: LevelRays, site: SiteFile, jobs: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], TubeMixture]]:
    centres = level.grid.centres
    if site.table.fit == "em":
        # scikit-learn holds the interpreter's lock, so its fits need processes.
        tasks = (delayed(fit_em)(centres[b], b, level, ExpectationMaximisation(seed=site.table.seed)) for b in blocks)
        yield from Parallel(n_jobs=jobs, return_as="generator")(tasks)
    else:
        # The compiled kernels release the lock, so threads share the rays without a copy.
        tasks = (delayed(fit_tubes)(centres[b], level, TubeFit()) for b in blocks)
        yield from Parallel(n_jobs=jobs, prefer="threads", return_as="generator")(tasks)


def _in_view(centres: NDArray[np.float64], station: Station, *, margin: float) -> NDArray[np.bool_]:
    """Cells whose centre lies in the station's field of view or hardly outside."""
    axis = local_to_scene(station.orientation)[:, 0]
    angle = np.arccos(np.clip(direction(centres[:, 0], centres[:, 1]) @ axis, -1.0, 1.0))
    return np.asarray(angle <= 0.5 * station.field_of_view + margin)


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
