"""Points along rays: candidate positions of the transmitter, each with its path length.

Steps 1 and 2 of the paper's Algorithm 1: directions are drawn around the measured angle of arrival (or, without one,
from all directions), rays are launched and reflected, and points are placed along them at regular steps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.scene_walls import scene_walls_of_table
from rayfix_offline.rays.launch import launch
from rayfix_offline.rays.segments import Segments
from rayfix_offline.scene.engine import EmbreeEngine, RayEngine
from rayfix_offline.scene.walls import Walls, opaque_walls
from rayfix_offline.twin.planes import Planes, merge_coplanar
from rayfix_service.fusion.measurements.directions import Direction
from rayfix_tables.geometry.angles import direction
from rayfix_tables.table import Table


@dataclass(frozen=True, kw_only=True)
class RayPoints:
    """Points on a station's rays.

    Attributes
    ----------
    position : ndarray of shape (n, 3), m
    path_length : ndarray of shape (n,), m
        Length from the station along the reflected ray, and what the slabs of the walls before it add.
    """

    position: NDArray[np.float64]
    path_length: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.path_length)

    def take(self, index: NDArray[np.int64]) -> "RayPoints":
        """Select points, in the order of ``index``."""
        return RayPoints(position=self.position[index], path_length=self.path_length[index])


@dataclass(frozen=True, kw_only=True)
class Launcher:
    """A scene to launch rays in.

    Attributes
    ----------
    walls : Walls
        Points have no power: losses only end what is too weak where walls let signals through.
    bounds : ndarray of shape (2, 3), m
        Low and high corner of the scene.
    max_path_length : float, m
    """

    engine: RayEngine
    planes: Planes
    walls: Walls
    bounds: NDArray[np.float64]
    max_reflections: int
    max_path_length: float

    @classmethod
    def of_table(cls, table: Table) -> "Launcher":
        """Create the launcher for a table's scene, with its limits."""
        propagation = table.site.document["propagation"]
        triangles = np.asarray(table.scene.vertices, np.float64)[table.scene.faces]
        corners = triangles.reshape(-1, 3)
        walls = scene_walls_of_table(table)
        if walls is None or not walls.passable.any():
            # The paper's points have no power.
            walls = opaque_walls(len(triangles), loss_db=0.0)
        return cls(
            engine=EmbreeEngine(triangles),
            planes=merge_coplanar(triangles),
            walls=walls,
            bounds=np.stack([corners.min(axis=0), corners.max(axis=0)]),
            max_reflections=int(propagation["max_reflections"]),
            max_path_length=float(propagation["max_path_length_m"]),
        )

    def trace(self, station: NDArray[np.float64], directions: NDArray[np.float64]) -> Segments:
        """Launch rays from a station, a position of shape (3,), m, in directions of shape (n_rays, 3), unit vectors."""
        return launch(
            station,
            directions,
            engine=self.engine,
            planes=self.planes,
            walls=self.walls,
            bounds=self.bounds,
            max_reflections=self.max_reflections,
            max_path_length=self.max_path_length,
        )


def draw_directions(measured: Direction, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw launch directions from N(angle of arrival, R), or uniformly if no angle was measured.

    Parameters
    ----------
    measured : Direction
        Both angles or none; in the scene frame.
    count : int

    Returns
    -------
    ndarray of shape (count, 3)
        Unit vectors.

    Raises
    ------
    ValueError
        If only one of the angles was measured.
    """
    if measured.azimuth is None and measured.zenith is None:
        vectors = rng.standard_normal((count, 3))
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    if measured.azimuth is None or measured.zenith is None:
        raise ValueError("the paper's method needs azimuth and zenith or no angle; leave the single angle out")
    angles = rng.multivariate_normal([measured.azimuth, measured.zenith], measured.cov, size=count)
    return direction(angles[:, 0], angles[:, 1])


def points_on_rays(
    launcher: Launcher,
    station: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    step: float,
    rng: np.random.Generator,
) -> RayPoints:
    """Launch rays and place points along them.

    Parameters
    ----------
    station : ndarray of shape (3,), m
    directions : ndarray of shape (n_rays, 3)
        Unit vectors.
    step : float, m
        Distance between points of a ray; the first point is at a random fraction of it from the station.
    """
    segments = launcher.trace(station, directions)
    phase = step * rng.random(len(directions))
    ray = segments.ray
    first = np.ceil((segments.start - phase[ray]) / step).astype(np.int64)
    last = np.ceil((segments.end - phase[ray]) / step).astype(np.int64)
    counts = np.maximum(last - first, 0)
    which = np.repeat(np.arange(len(ray)), counts)
    number = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts) + first[which]
    length = phase[ray[which]] + step * number
    sequence = segments.sequence[which]
    images, mirrors = segments.sequences.images, segments.sequences.mirrors
    heading = np.einsum("nij,nj->ni", mirrors[segments.sequence], directions[ray])
    return RayPoints(
        position=images[sequence] + length[:, None] * heading[which], path_length=length + segments.excess[which]
    )
