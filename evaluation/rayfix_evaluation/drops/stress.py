"""Wrong reports and twins: outliers, wrong standard deviations, rotated stations, moved objects."""

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rayfix_tables.geometry.angles import angles_of, direction

_TOUCHING = 0.02
"""Parts of the scene with boxes closer than this, m, are one object."""

Document = dict[str, Any]


def with_random_angle(report: Document, station_id: str, rng: np.random.Generator) -> Document:
    """Copy a report with a station's angle of arrival drawn uniformly from all directions."""
    changed = copy.deepcopy(report)
    for measurement in changed["measurements"]:
        if measurement["type"] == "aoa" and measurement["station_id"] == station_id:
            measurement["azimuth_deg"] = float(rng.uniform(-180.0, 180.0))
            measurement["zenith_deg"] = float(np.degrees(np.arccos(rng.uniform(-1.0, 1.0))))
    return changed


def with_late_time(report: Document, station_id: str, delay: float) -> Document:
    """Copy a report with a delay [m] of one station's clock reading, in all measurements that use it."""
    changed = copy.deepcopy(report)
    for measurement in changed["measurements"]:
        if "range_m" in measurement and measurement["station_id"] == station_id:
            measurement["range_m"] += delay
        if measurement["type"] == "tdoa":
            late = (measurement["station_id"] == station_id) - (measurement["reference_station_id"] == station_id)
            measurement["range_difference_m"] += late * delay
    return changed


def with_scaled_stdevs(report: Document, factor: float) -> Document:
    """Copy a report with all stated standard deviations multiplied by a factor."""
    changed = copy.deepcopy(report)
    for measurement in changed["measurements"]:
        for key in ("azimuth_stdev_deg", "zenith_stdev_deg", "stdev_m"):
            if key in measurement:
                measurement[key] *= factor
    return changed


def with_turned_stations(report: Document, angle: float, rng: np.random.Generator) -> Document:
    """Copy a report with the angles of rotated stations.

    Parameters
    ----------
    angle : float, rad
        Rotation of each station, about an axis that is drawn uniformly from all directions.
    """
    changed = copy.deepcopy(report)
    for measurement in changed["measurements"]:
        if measurement["type"] == "aoa":
            axis = rng.standard_normal(3)
            axis /= np.linalg.norm(axis)
            azimuth, zenith = np.deg2rad([measurement["azimuth_deg"], measurement["zenith_deg"]])
            seen = direction(azimuth, zenith)
            # Rodrigues' formula.
            turned = (
                np.cos(angle) * seen
                + np.sin(angle) * np.cross(axis, seen)
                + (1.0 - np.cos(angle)) * (axis @ seen) * axis
            )
            azimuth, zenith = angles_of(turned)
            measurement["azimuth_deg"], measurement["zenith_deg"] = (
                float(np.degrees(azimuth)),
                float(np.degrees(zenith)),
            )
    return changed


def move_scene(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    stations: NDArray[np.float64],
    *,
    objects: float,
    walls: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Move the objects of a scene on the floor and the outer walls of its building along their normals.

    Parameters
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
    faces : ndarray of int, shape (n_faces, 3)
    stations : ndarray of shape (n_stations, 3), m
        The part of the mesh with a box that contains all stations is the building; the rest are objects. Touching parts
        are one object.
    objects : float, m
        Displacement of each object, in a random horizontal direction.
    walls : float, m
        Displacement of each side of the building's box, inwards or outwards.

    Returns
    -------
    ndarray of shape (n_vertices, 3), m
        The vertices after the move.
    """
    part = _parts(vertices, faces)
    count = int(part.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, vertices)
    np.maximum.at(high, part, vertices)
    building = np.all((low <= stations.min(axis=0)) & (high >= stations.max(axis=0)), axis=1)
    inner = np.flatnonzero(~building)
    moved = np.array(vertices, np.float64)
    near = np.all(
        (low[inner, None] - _TOUCHING <= high[inner]) & (low[inner] - _TOUCHING <= high[inner, None]), axis=-1
    )
    num_objects, which = connected_components(near, directed=False)
    heading = rng.uniform(0.0, 2.0 * np.pi, num_objects)
    shift = np.zeros((count, 3))
    shift[inner] = objects * np.stack([np.cos(heading), np.sin(heading), 0.0 * heading], axis=-1)[which]
    moved += shift[part]
    for n in np.flatnonzero(building):
        for bound in (low[n], high[n]):
            sign = rng.choice([-1.0, 1.0], size=3)
            on_side = (part == n)[:, None] & np.isclose(vertices, bound, rtol=0.0, atol=1e-6)
            moved += on_side * sign * walls
    return moved


def _parts(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Label the connected part of the mesh of each vertex, shape (n_vertices,)."""
    place = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)[1].reshape(-1)  # a column with NumPy 2.0
    edges = place[np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])]
    size = int(place.max()) + 1
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(size, size))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)[place]
