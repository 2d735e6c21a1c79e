"""Small tables of random numbers."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rayfix_tables.compact.tubes import CompactTubes, compacted
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import Level
from rayfix_tables.mixture import FIELD_SHAPES, TubeMixture, pack
from rayfix_tables.part import StationPart
from rayfix_tables.paths import PathMap
from rayfix_tables.scene import Scene
from rayfix_tables.site import SiteInfo, Station, StationBias
from rayfix_tables.write import write_table


@dataclass(frozen=True, kw_only=True)
class Content:
    """What a table is written from."""

    site: SiteInfo
    scene: Scene
    parts: tuple[StationPart, ...]

    def write(self, path: Path, *, software_version: str = "1.2.3") -> str:
        """Write it and return its ``table_id``."""
        return write_table(path, site=self.site, scene=self.scene, parts=self.parts, software_version=software_version)


def random_mixture(rng: np.random.Generator, count: int, *, walls: bool = False) -> TubeMixture:
    """Numbers of no meaning in the types of a table."""
    fields = {
        name: rng.normal(size=(count, *shape)).astype(np.float32)
        for name, shape in FIELD_SHAPES.items()
        if name != "num_walls"
    }
    fields["num_reflections"] = rng.integers(0, 4, count).astype(np.int8)
    fields["num_walls"] = (np.arange(count) % 3 if walls else np.zeros(count)).astype(np.int8)
    return TubeMixture(**fields)


def random_paths(rng: np.random.Generator, free_space: FreeSpace, *, walls: bool = False) -> PathMap:
    """Paths of no meaning to voxels of twice the size of the free space's."""
    shape = tuple((-(-np.array(free_space.free.shape) // 2)).tolist())
    own = np.random.default_rng(2)  # what came later does not change the numbers of stored tables
    counts, num_sequences = rng.integers(0, 4, int(np.prod(shape))), 5
    return PathMap(
        origin=free_space.origin,
        voxel_size=2.0 * free_space.voxel_size,
        shape=shape,
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        sequence=rng.integers(0, num_sequences, int(counts.sum())).astype(np.int32),
        weight=rng.random(int(counts.sum())).astype(np.float32),
        excess=rng.random(int(counts.sum()) * walls).astype(np.float32),
        num_walls=rng.integers(0, 4, int(counts.sum()) * walls).astype(np.int8),
        images=rng.normal(size=(num_sequences, 3)),
        mirrors=rng.normal(size=(num_sequences, 3, 3)),
        num_reflections=rng.integers(0, 4, num_sequences).astype(np.int8),
        log_gain=-own.random(int(counts.sum())).astype(np.float16),
        lit=own.random(int(counts.sum())).astype(np.float16),
    )


def random_content(
    seed: int,
    *,
    num_stations: int = 2,
    num_levels: int = 2,
    num_faces: int = 5,
    max_components: int = 3,
    walls: bool = False,
) -> Content:
    """Fill a table with random numbers; cells hold none to ``max_components`` components, and paths pass walls or not.

    Without walls, the numbers are those of the stored tables of former formats.
    """
    rng = np.random.default_rng(seed)
    stations, parts = [], []
    for n in range(num_stations):
        stations.append(
            Station(
                id=f"bs{n}",
                position=tuple(rng.uniform(-9, 9, 3).tolist()),
                orientation=tuple(rng.uniform(-3, 3, 3).tolist()),
                field_of_view=rng.uniform(0.5, 6.0),
                bias=StationBias(
                    range=rng.normal(),
                    range_stdev=rng.random(),
                    azimuth=rng.normal(),
                    zenith=rng.normal(),
                    angle_stdev=rng.random(),
                ),
            )
        )
        levels: list[Level] = []
        for window in 0.3 * 2.0 ** np.arange(num_levels):
            grid = AngularGrid.from_spacing(window / 0.8)
            counts = rng.integers(0, max_components + 1, grid.num_cells)
            levels.append(
                Level(
                    window=float(window),
                    grid=grid,
                    cell_offsets=np.concatenate([[0], np.cumsum(counts)]),
                    cell_log_mass=np.where(counts > 0, rng.normal(size=len(counts)), -np.inf),
                    mixture=random_mixture(rng, int(counts.sum()), walls=walls),
                    log_balance=rng.normal(size=int(counts.sum()) * (not levels)).astype(np.float32),  # the first only
                )
            )
        parts.append(
            StationPart(
                station=stations[-1],
                levels=tuple(levels),
                lost_ray_share=rng.random(),
                coverage=tuple(rng.random(3).tolist()),
                wall_coverage=(0.25, 0.5) if walls else (),
                cut_power_share=0.125 if walls else 0.0,
            )
        )
    site = SiteInfo(
        name=f"site {seed}",
        north=rng.uniform(-3, 3),
        max_path_length=rng.uniform(1, 99),
        stations=tuple(stations),
        document={"site": {"name": "ß", "seed": seed}, "stations": [s.id for s in stations]},
    )
    scene = Scene(
        vertices=rng.normal(size=(3 * num_faces, 3)),
        faces=rng.integers(0, 3 * num_faces, (num_faces, 3)).astype(np.int32),
        face_materials=rng.integers(-1, 2, num_faces).astype(np.int16),
        materials=("itu_concrete", "itu_metal"),
        free_space=FreeSpace(origin=rng.normal(size=3), voxel_size=0.1, free=rng.random((3, 4, 2)) < 0.5),
        sha256=f"{seed:064x}",
        face_thickness=np.where(np.arange(num_faces) % 2, 0.125, np.nan) if walls else None,
    )
    return Content(
        site=site,
        scene=scene,
        parts=tuple(replace(part, paths=random_paths(rng, scene.free_space, walls=walls)) for part in parts),
    )


def random_tubes(rng: np.random.Generator, count: int, window: float, *, longest: float = 50.0) -> TubeMixture:
    """Tubes like those of rays, in double precision: spreads from millimetres to metres, correlated at random."""
    length = rng.uniform(0.05, longest, count)
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] + 0.05 * rng.normal(size=(count, 3, 3))
    roots = []
    for least, most in ((0.02, 2.0), (2e-3, 1.0)):
        root = np.tril(rng.normal(size=(count, 3, 3)), -1) * 10.0 ** rng.uniform(-3.0, 0.0, (count, 1, 1))
        root[:, range(3), range(3)] = np.exp(rng.uniform(np.log(least), np.log(most), (count, 3)))
        roots.append(root)
    roots[0][:, 1:] *= window
    return TubeMixture(
        log_weight=-rng.exponential(4.0, count),
        u_mean=np.column_stack([length, window * rng.normal(size=(count, 2))]),
        u_cov=pack(roots[0] @ roots[0].transpose(0, 2, 1)),
        x_mean=rng.uniform(-longest, longest, (count, 3)),
        jacobian=turn * np.stack([np.ones(count), length, length], axis=-1)[:, None],
        x_cov=pack(roots[1] @ roots[1].transpose(0, 2, 1)),
        num_reflections=rng.integers(0, 4, count).astype(np.int8),
        num_walls=np.zeros(count, np.int8),
    )


def compact_content(seed: int, *, walls: bool = False, **sizes: int) -> Content:
    """Fill a table with compact components and path maps."""
    content = random_content(seed, walls=walls, **sizes)
    rng = np.random.default_rng([seed, 5])

    def compact(level: Level) -> Level:
        tubes = random_tubes(rng, len(level.mixture), level.window)
        tubes = replace(tubes, num_walls=level.mixture.num_walls)
        return replace(level, mixture=compacted(tubes, level.window), log_balance=level.log_balance.astype(np.float16))

    parts = []
    for part in content.parts:
        assert part.paths is not None
        levels = tuple(compact(level) for level in part.levels)
        assert all(isinstance(level.mixture, CompactTubes) for level in levels)
        parts.append(replace(part, levels=levels, paths=part.paths.compacted))
    return replace(content, parts=tuple(parts))
