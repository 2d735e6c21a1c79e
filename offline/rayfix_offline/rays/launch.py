"""Launch rays from a station, and trace their reflections and their ways through walls.

Only path lengths are stored: after a reflection sequence a ray is the line ``image + length * mirror @ direction``,
where ``image`` is the station mirrored at the planes of the sequence and ``mirror`` the product of their reflections. A
hit point therefore takes one division, whatever the number of reflections, and rounding errors do not accumulate. A
wall that is passed changes nothing of that: the ray goes on along its sequence, with less gain.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_offline.rays.crossings import Barriers, cross_walls
from rayfix_offline.rays.hits import Lines, Mirrors, find_hits, starts_beside
from rayfix_offline.rays.segments import Segments
from rayfix_offline.rays.sequence_table import SequenceTable
from rayfix_offline.rays.settings import RaySettings
from rayfix_offline.scene.engine import RayEngine
from rayfix_offline.scene.walls import Walls
from rayfix_offline.twin.planes import Planes


def launch(
    station: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    engine: RayEngine,
    planes: Planes,
    walls: Walls,
    bounds: NDArray[np.float64],
    max_reflections: int,
    max_path_length: float,
    settings: RaySettings | None = None,
) -> Segments:
    """Launch rays; at the walls that they hit, they are reflected and go on straight.

    Parameters
    ----------
    station : ndarray of shape (3,), m
    directions : ndarray of shape (n_rays, 3)
        Unit vectors.
    walls : Walls
        Of the engine's triangles.
    bounds : ndarray of shape (2, 3), m
        Low and high corner of the scene; a ray that hits no triangle ends there.
    max_path_length : float, m
        Rays end at this unfolded length.
    settings : RaySettings, optional
    """
    settings = settings or RaySettings()
    num_rays = len(directions)
    # All that single precision holds counts from the engine's origin; what is returned, from the scene's.
    station, bounds = station - engine.origin, bounds - engine.origin
    scene = Barriers(
        engine=engine,
        planes=Mirrors(planes.face_planes, planes.normals, planes.offsets - planes.normals @ engine.origin),
        walls=walls,
        bounds=bounds,
        offset=settings.mirror_offset * (1.0 + float(np.abs(bounds).max())),
        max_inner_hits=settings.max_inner_hits,
    )
    limits = _Limits.of(walls, max_reflections, settings)
    table = SequenceTable(station)
    branches = _Branches.of_rays(num_rays)
    origins = np.broadcast_to(station.astype(np.float32), (num_rays, 3))
    headings = directions.astype(np.float32)
    generations: list[tuple[_Branches, NDArray[np.float64]]] = []
    num_lost, power_cut = 0, 0.0
    while len(branches.ray):
        faces = engine.first_hit(origins, headings)
        lines = branches.lines(directions, table)
        hit, reach, approach = find_hits(lines, branches.start, faces, scene.planes, bounds)
        # Beyond the outer walls there is nothing to hit.
        num_lost += int(np.count_nonzero(~hit & (branches.num_walls == 0)))
        generations.append((branches, np.minimum(reach, max_path_length)))
        depth = table.arrays.num_reflections[branches.sequence]
        (on,) = np.nonzero(
            hit & (reach < max_path_length) & ((depth < max_reflections) | (limits.any_passes & walls.passable[faces]))
        )
        branches, lines, depth = branches.only(on), lines.only(on), depth[on]
        faces, reach, approach = faces[on], reach[on], approach[on]
        ways = cross_walls(lines, branches.start, faces, reach, approach, scene)

        log_gain = branches.log_gain + walls.reflected(faces, np.abs(approach), ways.thickness)
        # What leaves a solid was reflected where it entered.
        chosen, cut = limits.mirrored(log_gain, depth, ~ways.leaving)
        power_cut += cut
        mirrored = branches.only(chosen)
        children = table.children(mirrored.sequence, faces[chosen], scene.planes)
        mirrored = replace(mirrored, sequence=children, start=reach[chosen], log_gain=log_gain[chosen])
        aside = -np.sign(approach[chosen]) * scene.offset
        starts = starts_beside(mirrored.lines(directions, table), mirrored.start, faces[chosen], aside, scene.planes)

        log_gain = branches.log_gain + ways.log_gain
        chosen, cut = limits.straight(log_gain, depth, branches.num_walls)
        power_cut += cut
        if not len(chosen):
            branches, (origins, headings) = mirrored, starts
            continue
        straight = branches.only(chosen)
        straight = replace(
            straight,
            start=ways.length[chosen],
            log_gain=log_gain[chosen],
            excess=straight.excess + ways.excess[chosen],
            num_walls=straight.num_walls + ~ways.leaving[chosen],
        )
        aside = np.sign(ways.approach[chosen]) * scene.offset
        beyond = starts_beside(lines.only(chosen), straight.start, ways.face[chosen], aside, scene.planes)
        branches = _Branches.joined([mirrored, straight])
        origins, headings = (np.concatenate(pair) for pair in zip(starts, beyond, strict=True))
    return Segments(
        **_by_ray(generations, num_rays),
        sequences=table.sequences(engine.origin),
        max_reflections=max_reflections,
        lost_ray_share=num_lost / max(1, num_rays),
        cut_power_share=power_cut / max(1, num_rays),
    )


@dataclass(frozen=True, kw_only=True)
class _Branches:
    """Branches of rays that have not ended: their next segments, without the ends; fields as in :class:`Segments`.

    Attributes
    ----------
    ray : ndarray of int64, shape (n,)
    """

    ray: NDArray[np.int64]
    sequence: NDArray[np.int32]
    start: NDArray[np.float64]
    log_gain: NDArray[np.float64]
    excess: NDArray[np.float64]
    num_walls: NDArray[np.int8]

    @classmethod
    def of_rays(cls, count: int) -> "_Branches":
        """Return rays at the station."""
        return cls(
            ray=np.arange(count),
            sequence=np.zeros(count, np.int32),
            start=np.zeros(count),
            log_gain=np.zeros(count),
            excess=np.zeros(count),
            num_walls=np.zeros(count, np.int8),
        )

    def only(self, index: NDArray[np.int64]) -> "_Branches":
        """Return chosen branches."""
        return _Branches(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    @classmethod
    def joined(cls, parts: "list[_Branches]") -> "_Branches":
        """Return the branches of all parts."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def lines(self, directions: NDArray[np.float64], table: SequenceTable) -> Lines:
        """Return the lines of the branches."""
        return Lines(directions, table.arrays.images, table.arrays.mirrors, self.ray, self.sequence)


@dataclass(frozen=True, kw_only=True)
class _Limits:
    """What ends a branch. In scenes where nothing lets signals through, the number of reflections alone does.

    Attributes
    ----------
    any_passes : bool
    straight_floor, mirrored_floor : float
        Logarithms to base 10 of the least gains of walls, of rays that are not reflected and of others.
    """

    any_passes: bool
    max_reflections: int
    max_walls: int
    straight_floor: float
    mirrored_floor: float

    @classmethod
    def of(cls, walls: Walls, max_reflections: int, settings: RaySettings) -> "_Limits":
        """Return the limits for a scene's walls."""
        return cls(
            any_passes=bool(walls.passable.any()),
            max_reflections=max_reflections,
            max_walls=settings.max_walls,
            straight_floor=-0.1 * settings.straight_floor_db,
            mirrored_floor=-0.1 * settings.mirrored_floor_db,
        )

    def mirrored(
        self, log_gain: NDArray[np.float64], depth: NDArray[np.int8], possible: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], float]:
        """Return the branches that go on mirrored, and the power of those that are too weak.

        Parameters
        ----------
        log_gain : ndarray of shape (n,)
            After the reflection.
        depth : ndarray of int8, shape (n,)
            Reflections before.
        possible : ndarray of bool, shape (n,)
        """
        possible = possible & (depth < self.max_reflections)
        weak = possible & (log_gain < self.mirrored_floor) & self.any_passes
        return np.flatnonzero(possible & ~weak), float(np.sum(10.0 ** log_gain[weak]))

    def straight(
        self, log_gain: NDArray[np.float64], depth: NDArray[np.int8], num_walls: NDArray[np.int8]
    ) -> tuple[NDArray[np.int64], float]:
        """Return the branches that go on straight; parameters and results as those of :meth:`mirrored`."""
        floor = np.where(depth > 0, self.mirrored_floor, self.straight_floor)
        strong = (log_gain >= floor) & (num_walls < self.max_walls)
        return np.flatnonzero(strong), float(np.sum(10.0 ** log_gain[~strong]))


def _by_ray(generations: list[tuple[_Branches, NDArray[np.float64]]], num_rays: int) -> dict[str, NDArray[Any]]:
    """Arrays of :class:`Segments`: the branches of all generations in the order of their rays."""
    branches = _Branches.joined([each for each, _ in generations])
    end = np.concatenate([ends for _, ends in generations])
    # Rays that have left the building hit nothing and end where they start.
    something = (branches.num_walls == 0) | (end > branches.start)
    if not something.all():
        branches, end = branches.only(np.flatnonzero(something)), end[something]
    offsets = np.concatenate([[0], np.cumsum(np.bincount(branches.ray, minlength=num_rays))])
    order = np.empty(len(end), np.int64)
    _sort(branches.ray, offsets[:-1].copy(), order)
    columns = {f.name: getattr(branches, f.name)[order] for f in fields(branches) if f.name != "ray"}
    return columns | {"offsets": offsets, "end": end[order]}


@numba.njit(cache=True, nogil=True)
def _sort(ray: Any, next_place: Any, order: Any) -> None:
    """Order segments by ray, those of a ray as they are. ``next_place`` begins with the first place of each ray."""
    for n in range(len(ray)):
        order[next_place[ray[n]]] = n
        next_place[ray[n]] += 1
