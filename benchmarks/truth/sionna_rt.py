"""The forward solver compared with Sionna RT: the same scene, stations and points, path by path.

Sionna RT (J. Hoydis et al., "Sionna RT: differentiable ray tracing for radio propagation modeling", 2023) shoots rays
to find which triangles a path may visit, and refines each candidate with the image method, in single precision. It
needs the extra ``sionna`` and, on a CPU, LLVM (docs/evaluation.md).
"""

import tempfile
from dataclasses import dataclass
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

_SCENE = """<scene version="2.1.0">
<bsdf type="itu-radio-material" id="walls">
<string name="type" value="metal"/><float name="thickness" value="0.1"/>
</bsdf>
<shape type="ply" id="mesh-all">
<string name="filename" value="all.ply"/><boolean name="face_normals" value="true"/><ref id="walls" name="bsdf"/>
</shape>
</scene>
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundPaths:
    """Paths between a station and a point.

    Attributes
    ----------
    path_length : ndarray of shape (n,), m
    direction : ndarray of shape (n, 3)
        Unit vectors from the station towards the incoming ray.
    """

    path_length: Array
    direction: Array

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.path_length)


def sionna_paths(
    vertices: Array,
    faces: NDArray[np.int64],
    stations: Array,
    points: Array,
    *,
    max_reflections: int,
    samples: int = 1_000_000,
    seed: int = 1,
) -> list[list[FoundPaths]]:
    """Find the specular paths of stations to points with Sionna RT.

    Parameters
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
    faces : ndarray of int of shape (n_faces, 3)
    stations, points : ndarray of shape (n, 3), m
    samples : int
        Rays that are shot from each point.

    Returns
    -------
    list of list of FoundPaths
        By point and station.
    """
    import sionna.rt as rt

    with tempfile.TemporaryDirectory() as folder:
        mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
        mesh.export(Path(folder) / "all.ply", vertex_normal=False)
        (Path(folder) / "scene.xml").write_text(_SCENE, encoding="utf-8")
        scene = rt.load_scene(str(Path(folder) / "scene.xml"), merge_shapes=False)
    scene.frequency = 3.5e9
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    for n, place in enumerate(stations.tolist()):
        scene.add(rt.Receiver(name=f"station-{n}", position=place))
    for n, place in enumerate(points.tolist()):
        scene.add(rt.Transmitter(name=f"point-{n}", position=place))
    paths = rt.PathSolver()(
        scene=scene,
        max_depth=max_reflections,
        los=True,
        specular_reflection=True,
        diffuse_reflection=False,
        refraction=False,
        synthetic_array=True,
        samples_per_src=samples,
        seed=seed,
    )
    valid = np.array(paths.valid, np.bool_)
    length = np.array(paths.tau, np.float64) * SPEED_OF_LIGHT
    towards = direction(np.array(paths.phi_r, np.float64), np.array(paths.theta_r, np.float64))

    def found(station: int, point: int) -> FoundPaths:
        kept = valid[station, point]
        return FoundPaths(path_length=length[station, point, kept], direction=towards[station, point, kept])

    return [[found(s, p) for s in range(len(stations))] for p in range(len(points))]


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
    short_segments: int
    only_ours: int
    only_theirs: int

    def __add__(self, other: "Agreement") -> "Agreement":
        """Join the comparisons of two pairs of ends."""
        return Agreement(
            num_common=self.num_common + other.num_common,
            largest_length=max(self.largest_length, other.largest_length),
            largest_angle=max(self.largest_angle, other.largest_angle),
            short_segments=self.short_segments + other.short_segments,
            only_ours=self.only_ours + other.only_ours,
            only_theirs=self.only_theirs + other.only_theirs,
        )


NOTHING_COMPARED = Agreement(
    num_common=0, largest_length=0.0, largest_angle=0.0, short_segments=0, only_ours=0, only_theirs=0
)


def compare(
    ours: Paths, theirs: FoundPaths, *, length: float = 1e-3, angle: float = float(np.deg2rad(0.01))
) -> Agreement:
    """Match paths one to one, the nearest first.

    Parameters
    ----------
    length : float, m
        Largest difference of the lengths of one path.
    angle : float, rad
        Largest angle between its directions.
    """
    headings = direction(ours.azimuth, ours.zenith)
    apart = np.abs(ours.path_length[:, None] - theirs.path_length)
    # The chord, since the arc cosine of nearly 1 is mostly rounding.
    chord = np.linalg.norm(headings[:, None] - theirs.direction, axis=-1)
    turned = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    worst = np.maximum(apart / length, turned / angle)
    mine, other = set(range(len(ours))), set(range(len(theirs)))
    largest_length = largest_angle = 0.0
    for flat in np.argsort(worst, axis=None, kind="stable").tolist():
        i, j = divmod(flat, max(1, len(theirs)))
        if worst[i, j] > 1.0:
            break
        if i in mine and j in other:
            mine.remove(i)
            other.remove(j)
            largest_length = max(largest_length, float(apart[i, j]))
            largest_angle = max(largest_angle, float(turned[i, j]))
    short = sum(shortest_segment(ours, i) < SHORTEST_SEGMENT for i in mine)
    return Agreement(
        num_common=len(ours) - len(mine),
        largest_length=largest_length,
        largest_angle=largest_angle,
        short_segments=short,
        only_ours=len(mine) - short,
        only_theirs=len(other),
    )


def shortest_segment(paths: Paths, index: int) -> float:
    """Length of a path's shortest segment, m."""
    corners: Any = paths.vertices[index, : int(paths.num_reflections[index]) + 2]
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).min())
