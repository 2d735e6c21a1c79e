"""Geometry for pictures of the scene: its box, its objects, ellipsoids of mixtures."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.table import Table

__all__ = ["Backdrop", "backdrop", "ellipsoids", "unit_sphere"]

Array = NDArray[np.float64]

_MOST_TRIANGLES = 20_000
"""Largest number of triangles that are drawn, those with the largest areas."""

_SHELL = 0.9
"""Triangles that span this fraction of the scene along two axes belong to the building's shell."""

_LEAST_WEIGHT = 0.01


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """The scene behind all pictures.

    Attributes
    ----------
    low, high : ndarray of shape (3,), m
        Corners of the scene.
    triangles : ndarray of shape (n, 3, 3), m
        Triangles of the objects, without the building's shell.
    stations : dict of str to ndarray of shape (3,), m
    """

    low: Array
    high: Array
    triangles: Array
    stations: dict[str, Array]

    def box_edges(self) -> Array:
        """Edges of the scene's box, shape (12, 2, 3), m."""
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        edges = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(corners[a] - corners[b]).sum() == 1]
        return np.asarray(self.low + corners[np.array(edges)] * (self.high - self.low))


def backdrop(table: Table) -> Backdrop:
    """Return the backdrop of a table's scene."""
    triangles = np.asarray(table.scene.vertices, np.float64)[np.asarray(table.scene.faces)]
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    size = triangles.max(axis=1) - triangles.min(axis=1)
    inner = triangles[np.sum(size > _SHELL * (high - low), axis=1) < 2]
    if len(inner) > _MOST_TRIANGLES:
        area = np.linalg.norm(np.cross(inner[:, 1] - inner[:, 0], inner[:, 2] - inner[:, 0]), axis=1)
        inner = inner[np.sort(np.argsort(-area)[:_MOST_TRIANGLES])]
    stations = {station.id: np.array(station.position) for station in table.site.stations}
    return Backdrop(low=low, high=high, triangles=inner, stations=stations)


def unit_sphere(rings: int = 9, segments: int = 16) -> tuple[Array, NDArray[np.int64]]:
    """Vertices of shape (n, 3) and triangles of shape (m, 3) of a sphere."""
    zenith = np.linspace(0.0, np.pi, rings)
    azimuth = np.arange(segments) * 2.0 * np.pi / segments
    ze, az = (grid.ravel() for grid in np.meshgrid(zenith, azimuth, indexing="ij"))
    vertices = np.stack([np.sin(ze) * np.cos(az), np.sin(ze) * np.sin(az), np.cos(ze)], axis=-1)
    faces = []
    for r in range(rings - 1):
        for s in range(segments):
            a, b = r * segments + s, r * segments + (s + 1) % segments
            faces += [[a, b, a + segments], [b, b + segments, a + segments]]
    return vertices, np.array(faces)


def ellipsoids(mixture: Mapping[str, Any] | None) -> Iterator[tuple[float, Array, Array]]:
    """Weight, centre [m] and square root of the covariance [m] of components with a weight of at least one per cent."""
    if mixture is None:
        return
    for weight, mean, cov in zip(mixture["weight"], mixture["mean"], mixture["cov"], strict=True):
        if weight >= _LEAST_WEIGHT:
            values, vectors = np.linalg.eigh(np.array(cov))
            yield float(weight), np.array(mean), vectors * np.sqrt(np.maximum(values, 0.0))
