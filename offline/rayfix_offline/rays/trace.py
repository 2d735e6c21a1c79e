"""The rays of one station: launched, cut into pieces and weighted by the path prior."""

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.pathmap import FieldOfView, fill_path_map, least_share
from rayfix_offline.rays.pathprior import fill_path_prior
from rayfix_offline.rays.pieces import Pieces, cut_pieces
from rayfix_offline.rays.rays import RaySet, sample_rays
from rayfix_offline.rays.segments import Segments, Sequences
from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.rays.surface_sequences import surface_sequences
from rayfix_offline.scene.materials import ReflectionSettings
from rayfix_offline.scene.walls import Walls, walls_of
from rayfix_offline.site import SiteFile, StationSection
from rayfix_offline.twin.twin import Twin
from rayfix_tables.geometry.mounting import board_to_scene
from rayfix_tables.grid import AngularGrid
from rayfix_tables.paths import PathMap


@dataclass(frozen=True, kw_only=True)
class LevelRays:
    """Rays that the cells of a level are fitted to.

    Attributes
    ----------
    window : float, rad
        Standard deviation of the cells' window.
    ray_spacing : float, rad
    surface_sequences : ndarray of int64, shape (n_sequences,)
        First of the sequences of the same surfaces as each one; their groups are joined.
    """

    window: float
    grid: AngularGrid
    rays: RaySet
    ray_spacing: float
    pieces: Pieces
    sequences: Sequences
    surface_sequences: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class StationTrace:
    """A station's rays and the statistics of the launch.

    Attributes
    ----------
    finest : LevelRays
        Rays of the finest level; the cells of the other levels are sums of its cells.
    lost_ray_share : float
        Fraction of the rays that left the scene instead of hitting a surface.
    coverage : tuple of float
        Fraction of the free space that is reached with at most 0, 1, 2, ... reflections.
    wall_coverage, cut_power_share
        As in :class:`~rayfix_tables.part.StationPart`.
    paths : PathMap
    """

    finest: LevelRays
    lost_ray_share: float
    coverage: tuple[float, ...]
    wall_coverage: tuple[float, ...]
    cut_power_share: float
    paths: PathMap

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the statistics of the launch and the path map as the arrays of a shard."""
        names = ("lost_ray_share", "coverage", "wall_coverage", "cut_power_share")
        return {name: np.array(getattr(self, name)) for name in names} | self.paths.to_arrays()


def level_grid(window: float, *, cells_per_window: float = RaySettings.cells_per_window) -> AngularGrid:
    """Grid of the cells of a window [rad]; their spacing is its standard deviation / ``cells_per_window``."""
    return AngularGrid.from_spacing(window / cells_per_window)


def prior_spacing(twin: Twin, settings: RaySettings | None = None) -> float:
    """Largest spacing of the rays that fill a site's path prior, rad."""
    settings = settings or RaySettings()
    far = float(np.linalg.norm(twin.scene.bounds[1] - twin.scene.bounds[0]))
    wanted = settings.prior_rays * settings.prior_refinement * twin.free_space.voxel_size / far
    return max(settings.prior_spacing, wanted)


def scene_walls(site: SiteFile, twin: Twin, settings: ReflectionSettings | None = None) -> Walls:
    """Return what the triangles of a site's scene reflect and let through."""
    return walls_of(site, twin.scene, twin.solid, twin.outward, settings)


def trace_station(
    station: StationSection,
    site: SiteFile,
    twin: Twin,
    *,
    settings: RaySettings | None = None,
    reflection: ReflectionSettings | None = None,
    jobs: int = 1,
) -> StationTrace:
    """Trace a station's rays and cut them into pieces.

    The directions depend only on the site's seed and the station's id.

    Parameters
    ----------
    settings : RaySettings, optional
    reflection : ReflectionSettings, optional
    jobs : int
        Threads; -1 for one per core. The trace is the same with any number.
    """
    settings = settings or RaySettings()
    window = float(np.deg2rad(site.table.windows_deg[0]))
    spacing = window / settings.rays_per_window
    widest = prior_spacing(twin, settings)
    walls = scene_walls(site, twin, reflection)

    def launched(spacing: float, *seed: int) -> tuple[RaySet, Segments]:
        return launch_rays(
            station,
            site,
            twin,
            spacing,
            np.random.default_rng([site.table.seed, *seed]),
            walls=walls,
            settings=settings,
        )

    name = int.from_bytes(hashlib.sha256(station.id.encode()).digest()[:8], "big")
    rays, segments = launched(spacing, name)
    prior_rays, prior_segments = launched(widest, name, 1) if spacing > widest else (rays, segments)
    exponent = site.propagation.path_prior_exponent
    prior = fill_path_prior(
        prior_rays,
        prior_segments,
        twin.free_space,
        exponent=exponent,
        refinement=settings.prior_refinement,
        jobs=jobs,
    )
    pieces = cut_pieces(
        rays,
        segments,
        prior,
        exponent=exponent,
        kind=site.propagation.path_prior,
        slice_ratio=settings.slice_ratio,
        first_node=settings.first_node,
        jobs=jobs,
    )
    finest = LevelRays(
        window=window,
        grid=level_grid(window, cells_per_window=settings.cells_per_window),
        rays=rays,
        ray_spacing=spacing,
        pieces=pieces,
        sequences=segments.sequences,
        surface_sequences=surface_sequences(segments.sequences, twin.planes),
    )
    looks = station.station()
    paths = fill_path_map(
        prior_rays,
        prior_segments,
        prior,
        exponent=exponent,
        kind=site.propagation.path_prior,
        least_share=least_share(settings.path_floor_db, exponent),
        field_of_view=FieldOfView(board_to_scene(looks)[:, 0], 0.5 * looks.field_of_view)
        if looks.field_of_view < 2.0 * np.pi
        else None,
        jobs=jobs,
    )
    return StationTrace(
        finest=finest,
        lost_ray_share=prior_segments.lost_ray_share,
        coverage=prior.coverage,
        wall_coverage=prior.wall_coverage,
        cut_power_share=segments.cut_power_share,
        paths=paths,
    )


def launch_rays(
    station: StationSection,
    site: SiteFile,
    twin: Twin,
    spacing: float,
    rng: np.random.Generator,
    *,
    walls: Walls | None = None,
    settings: RaySettings | None = None,
) -> tuple[RaySet, Segments]:
    """Launch a station's rays.

    Parameters
    ----------
    spacing : float, rad
        Between neighbouring rays.
    walls : Walls, optional
        The site's when left out.
    settings : RaySettings, optional
    """
    rays = sample_rays(spacing, rng)
    segments = launch(
        np.array(station.position_m),
        rays.directions,
        engine=twin.engine,
        planes=twin.planes,
        walls=walls if walls is not None else scene_walls(site, twin),
        bounds=twin.scene.bounds,
        max_reflections=site.propagation.max_reflections,
        max_path_length=site.propagation.max_path_length_m,
        settings=settings,
    )
    return rays, segments
