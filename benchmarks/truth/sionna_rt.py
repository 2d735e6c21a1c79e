"""The forward solver compared with Sionna RT: the same scene, stations and points, path by path.

Sionna RT (J. Hoydis et al., "Sionna RT: differentiable ray tracing for radio propagation modeling", 2023) shoots rays
to find which triangles a path may visit, and refines each candidate with the image method, in single precision. It
needs the extra ``sionna`` and, on a CPU, LLVM (docs/evaluation.md).
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward import Paths
from rayfix_service.measuring.ranging import SPEED_OF_LIGHT
from rayfix_tables.geometry.angles import direction

Array = NDArray[np.float64]

SHORTEST_SEGMENT = 0.01
"""Sionna RT leaves out paths with a shorter segment, m."""

_SHAPE = """<bsdf type="itu-radio-material" id="{material}-{n}">
<string name="type" value="{material}"/><float name="thickness" value="{thickness}"/>
<float name="scattering_coefficient" value="{scattering}"/>
</bsdf>
<shape type="ply" id="mesh-{n}">
<string name="filename" value="{n}.ply"/><boolean name="face_normals" value="true"/>
<ref id="{material}-{n}" name="bsdf"/>
</shape>
"""

_MOST_PATHS = 4_000_000
"""Candidates for which Sionna RT keeps room; beyond these it drops paths silently."""

_SPECULAR, _DIFFUSE, _REFRACTION, _DIFFRACTION = 1, 2, 4, 8


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundPaths:
    """Paths between a station and a point.

    Attributes
    ----------
    path_length : ndarray of shape (n,), m
    direction : ndarray of shape (n, 3)
        Unit vectors from the station towards the incoming ray.
    gain_db : ndarray of shape (n,), dB
        Power gain relative to one metre of free space, the mean of two polarisations sent, both received.
    num_reflections, num_walls : ndarray of int of shape (n,)
        Mirrorings and walls passed.
    others : ndarray of int of shape (n,)
        Diffractions and diffuse reflections.
    """

    path_length: Array
    direction: Array
    gain_db: Array
    num_reflections: NDArray[np.int64]
    num_walls: NDArray[np.int64]
    others: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.path_length)

    def chosen(self, indices: NDArray[Any]) -> "FoundPaths":
        """Select paths by their indices, or by a mask."""
        return FoundPaths(**{field.name: getattr(self, field.name)[indices] for field in fields(self)})


@dataclass(frozen=True, kw_only=True)
class Physics:
    """What Sionna RT simulates.

    Attributes
    ----------
    carrier_ghz : float
    refraction : bool
        Whether sheets let signals through; each passage counts as one interaction there.
    max_interactions : int or None
        Bounces and passages together; the number of reflections if None.
    diffraction : bool
        At wedges and at free edges.
    scattering : float
        Share of the reflected amplitude that is scattered and that reflections lack; 0 for none.
    trace_scattered : bool
        Whether scattered rays are traced, too. Each carries next to nothing, and there are so many of them that with
        several receivers other paths find no room.
    """

    carrier_ghz: float = 3.5
    refraction: bool = False
    max_interactions: int | None = None
    diffraction: bool = False
    scattering: float = 0.0
    trace_scattered: bool = False


def sionna_paths(
    vertices: Array,
    faces: NDArray[np.int64],
    stations: Array,
    points: Array,
    *,
    max_reflections: int,
    materials: Sequence[str] | None = None,
    thickness: Mapping[str, float] | None = None,
    physics: Physics | None = None,
    samples: int = 1_000_000,
    seed: int = 1,
    from_stations: bool = False,
) -> list[list[FoundPaths]]:
    """Find the paths of stations to points with Sionna RT.

    Parameters
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
    faces : ndarray of int of shape (n_faces, 3)
    stations, points : ndarray of shape (n, 3), m
    max_reflections : int
        Paths with more reflections, diffractions and scatterings together are left out.
    materials : sequence of str, optional
        ITU material of each face; metal when left out.
    thickness : mapping of str to float, optional
        Thickness of the materials, m; 0.1 when left out.
    physics : Physics, optional
    samples : int
        Rays that are shot from each point.
    from_stations : bool
        Whether they are shot from each station instead, which is faster with many points.

    Returns
    -------
    list of list of FoundPaths
        By point and station.
    """
    import sionna.rt as rt

    physics = physics or Physics()
    names = np.array(materials if materials is not None else ["metal"] * len(faces))
    with tempfile.TemporaryDirectory() as folder:
        shapes = []
        for n, material in enumerate(sorted(set(names))):
            mesh = trimesh.Trimesh(vertices=vertices, faces=faces[names == material], process=False)
            mesh.remove_unreferenced_vertices()
            # An edge is one only where triangles share their corners.
            mesh.merge_vertices()
            mesh.export(Path(folder) / f"{n}.ply", vertex_normal=False)
            thick = (thickness or {}).get(material, 0.1)
            shapes.append(_SHAPE.format(n=n, material=material, thickness=thick, scattering=physics.scattering))
        (Path(folder) / "scene.xml").write_text(
            '<scene version="2.1.0">\n' + "".join(shapes) + "</scene>\n", encoding="utf-8"
        )
        scene = rt.load_scene(str(Path(folder) / "scene.xml"), merge_shapes=False)
    scene.frequency = physics.carrier_ghz * 1e9
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="VH")
    sources, targets = (stations, points) if from_stations else (points, stations)
    for n, place in enumerate(targets.tolist()):
        scene.add(rt.Receiver(name=f"target-{n}", position=place))
    solver = rt.PathSolver()
    found = []
    # One source at a time, which bounds the memory.
    for place in sources.tolist():
        scene.add(rt.Transmitter(name="source", position=place))
        paths = solver(
            scene=scene,
            max_depth=physics.max_interactions or max_reflections,
            los=True,
            specular_reflection=True,
            diffuse_reflection=physics.trace_scattered,
            refraction=physics.refraction,
            diffraction=physics.diffraction,
            edge_diffraction=physics.diffraction,
            synthetic_array=True,
            samples_per_src=samples,
            max_num_paths_per_src=_MOST_PATHS,
            seed=seed,
        )
        end = (paths.phi_t, paths.theta_t) if from_stations else (paths.phi_r, paths.theta_r)
        towards = direction(*(np.array(angle, np.float64)[:, 0] for angle in end))
        found.append(_by_target(paths, towards, physics, max_reflections))
        scene.remove("source")
    return [list(by_station) for by_station in zip(*found, strict=True)] if from_stations else found


def _by_target(paths: Any, towards: Array, physics: Physics, max_reflections: int) -> list[FoundPaths]:
    """Paths of the only transmitter to each receiver; ``towards`` of shape (n_targets, n_paths, 3)."""
    valid = np.array(paths.valid, np.bool_)[:, 0]
    amplitude = np.array(paths.a[0], np.float64) + 1j * np.array(paths.a[1], np.float64)
    # Both polarisations sent, one after the other, and the power of both received.
    power = 0.5 * (np.abs(amplitude[:, :, 0]) ** 2).sum(axis=(1, 2))
    unit = SPEED_OF_LIGHT / (physics.carrier_ghz * 1e9) / (4.0 * np.pi)
    kinds = np.array(paths.interactions, np.int64)[:, :, 0]
    length = np.array(paths.tau, np.float64)[:, 0] * SPEED_OF_LIGHT
    reflections = (kinds == _SPECULAR).sum(axis=0)
    walls = (kinds == _REFRACTION).sum(axis=0)
    others = ((kinds == _DIFFUSE) | (kinds == _DIFFRACTION)).sum(axis=0)
    kept = valid & (reflections + others <= max_reflections) & (power > 0.0)
    return [
        FoundPaths(
            path_length=length[n, kept[n]],
            direction=towards[n, kept[n]],
            gain_db=10.0 * np.log10(power[n, kept[n]] / unit**2),
            num_reflections=reflections[n, kept[n]],
            num_walls=walls[n, kept[n]],
            others=others[n, kept[n]],
        )
        for n in range(len(valid))
    ]


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How two solvers' paths between the same ends compare.

    Attributes
    ----------
    num_common : int
    largest_length : float, m
        Largest difference of the lengths of common paths.
    largest_angle : float, rad
        Largest angle between the directions of common paths.
    gains_apart : tuple of float, dB
        Differences of the gains of common paths.
    short_segments : int
        Paths that only the forward solver has, with a segment that is too short for Sionna RT.
    only_ours : int
        Other paths that only the forward solver has.
    only_theirs : int
        Paths that only Sionna RT has.
    """

    num_common: int
    largest_length: float
    largest_angle: float
    gains_apart: tuple[float, ...]
    short_segments: int
    only_ours: int
    only_theirs: int

    def __add__(self, other: "Agreement") -> "Agreement":
        """Join the comparisons of two pairs of ends."""
        return Agreement(
            num_common=self.num_common + other.num_common,
            largest_length=max(self.largest_length, other.largest_length),
            largest_angle=max(self.largest_angle, other.largest_angle),
            gains_apart=self.gains_apart + other.gains_apart,
            short_segments=self.short_segments + other.short_segments,
            only_ours=self.only_ours + other.only_ours,
            only_theirs=self.only_theirs + other.only_theirs,
        )

    def share_within(self, decibels: float) -> float:
        """Share of the common paths whose gains differ by no more than this; 1 without any."""
        apart = np.abs(np.array(self.gains_apart, np.float64))
        return float((apart <= decibels).mean()) if len(apart) else 1.0


NOTHING_COMPARED = Agreement(
    num_common=0,
    largest_length=0.0,
    largest_angle=0.0,
    gains_apart=(),
    short_segments=0,
    only_ours=0,
    only_theirs=0,
)


def compare(
    ours: Paths,
    theirs: FoundPaths,
    *,
    length: float = 1e-3,
    angle: float = float(np.deg2rad(0.01)),
    range_db: float = np.inf,
) -> Agreement:
    """Match paths one to one, the nearest first; of those that are equally near, the one with the nearest gain.

    Parameters
    ----------
    length : float, m
        Largest difference of the lengths of one path.
    angle : float, rad
        Largest angle between its directions.
    range_db : float, dB
        Weaker paths, relative to the strongest of both solvers, may be missing.
    """
    headings = direction(ours.azimuth, ours.zenith)
    apart = np.abs(ours.path_length[:, None] - theirs.path_length)
    # The chord, since the arc cosine of nearly 1 is mostly rounding.
    chord = np.linalg.norm(headings[:, None] - theirs.direction, axis=-1)
    turned = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    worst = np.maximum(apart / length, turned / angle)
    gains = ours.gain_db[:, None] - theirs.gain_db
    # Paths that mirror each other at equal distances have one length and one direction.
    order = np.lexsort((np.abs(gains).ravel(), np.round(worst, 1).ravel()))
    floor = max(ours.gain_db.max(initial=-np.inf), theirs.gain_db.max(initial=-np.inf)) - range_db
    mine, other = set(range(len(ours))), set(range(len(theirs)))
    pairs = []
    for flat in order.tolist():
        i, j = divmod(flat, max(1, len(theirs)))
        if worst[i, j] > 1.0:
            break
        if i in mine and j in other:
            mine.remove(i)
            other.remove(j)
            if max(ours.gain_db[i], theirs.gain_db[j]) >= floor:
                pairs.append((i, j))
    missing = [i for i in mine if ours.gain_db[i] >= floor]
    short = sum(shortest_segment(ours, i) < SHORTEST_SEGMENT for i in missing)
    return Agreement(
        num_common=len(pairs),
        largest_length=max((float(apart[pair]) for pair in pairs), default=0.0),
        largest_angle=max((float(turned[pair]) for pair in pairs), default=0.0),
        gains_apart=tuple(float(gains[pair]) for pair in pairs),
        short_segments=short,
        only_ours=len(missing) - short,
        only_theirs=sum(bool(theirs.gain_db[j] >= floor) for j in other),
    )


def shortest_segment(paths: Paths, index: int) -> float:
    """Length of a path's shortest segment between bounces, walls and ends, m."""
    corners = paths.vertices[index, : int(paths.num_reflections[index]) + 2]
    along = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    stations = [np.concatenate([[0.0], np.cumsum(along)])]
    for crossing in paths.crossings[index, : int(paths.num_walls[index])]:
        # The segment whose ends' distances to the crossing add up to its own length.
        gap = np.linalg.norm(corners - crossing, axis=1)
        on = int(np.argmin(gap[:-1] + gap[1:] - along))
        stations.append(np.array([stations[0][on] + gap[on]]))
    ordered = np.sort(np.concatenate(stations))
    return float(np.diff(ordered).min())
