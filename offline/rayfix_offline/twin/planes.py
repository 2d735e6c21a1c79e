"""Mirror planes: coplanar triangles are merged into one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.topology import connect, number_rows


@dataclass(frozen=True, kw_only=True)
class Planes:
    """The mirror planes of a scene, ``normal . x = offset``.

    Attributes
    ----------
    normals : ndarray of shape (n_planes, 3)
        Unit normals; both sides reflect.
    offsets : ndarray of shape (n_planes,), m
    face_planes : ndarray of int32, shape (n_faces,)
        Plane of each triangle.
    surfaces : ndarray of int32, shape (n_planes,)
        Surface of each plane; the facets of a curved surface share one.
    """

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    face_planes: NDArray[np.int32]
    surfaces: NDArray[np.int32]

    @property
    def num_surfaces(self) -> int:
        """Number of surfaces."""
        return int(self.surfaces.max(initial=-1)) + 1

    @property
    def curved(self) -> bool:
        """Whether some planes share a surface."""
        return self.num_surfaces < len(self)

    def __len__(self) -> int:
        """Return the number of planes."""
        return len(self.offsets)


def merge_coplanar(
    triangles: NDArray[np.float64],
    *,
    tolerance: float = TwinSettings.plane_tolerance,
    rounding: float = TwinSettings.plane_rounding,
) -> Planes:
    """Merge coplanar triangles into planes; they need not touch. Each plane is a surface of its own.

    Parameters
    ----------
    triangles : ndarray of shape (n_faces, 3, 3), m
    tolerance : float, m
        Largest distance between merged planes anywhere within the scene.
    rounding : float
        Planes are rounded to this fraction of the tolerance before they are compared.
    """
    corners = triangles.reshape(-1, 3)
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = float(np.linalg.norm(corners - centre, axis=1).max())
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = np.linalg.norm(crosses, axis=1)
    normals = crosses / areas[:, None]
    offsets = np.einsum("ij,ij->i", normals, triangles.mean(axis=1) - centre)

    # A plane has two normals. Both are used and linked, so that no sign convention can split a plane.
    features = np.concatenate([normals * radius, offsets[:, None]], axis=1)
    both = np.concatenate([features, -features])
    # Rounding comes first: thousands of triangles of one floor would have millions of pairs.
    step = rounding * tolerance
    steps = np.round(both / step)
    inverse = number_rows(steps)
    rounded = steps[np.unique(inverse, return_index=True)[1]]
    pairs = cKDTree(rounded * step).query_pairs(tolerance, output_type="ndarray")
    count = len(triangles)
    links = np.concatenate([pairs, np.stack([inverse[:count], inverse[count:]], axis=1)])
    labels = connect(links, len(rounded))
    _, first, face_planes = np.unique(labels[inverse[:count]], return_index=True, return_inverse=True)
    first, face_planes = _unchained(features, first, face_planes, tolerance)

    # The mean over the plane's area, so that all rays of a reflection sequence share one exact mirror image.
    signs = np.sign(np.einsum("ij,ij->i", normals, normals[first][face_planes]))
    plane_normals = np.zeros((len(first), 3))
    np.add.at(plane_normals, face_planes, normals * (signs * areas)[:, None])
    plane_normals /= np.linalg.norm(plane_normals, axis=1)[:, None]
    middle = np.zeros((len(first), 3))
    np.add.at(middle, face_planes, triangles.mean(axis=1) * areas[:, None])
    middle /= np.bincount(face_planes, weights=areas)[:, None]
    return Planes(
        normals=plane_normals,
        offsets=np.einsum("ij,ij->i", plane_normals, middle),
        face_planes=face_planes.astype(np.int32),
        surfaces=np.arange(len(first), dtype=np.int32),
    )


def _unchained(
    features: NDArray[np.float64], first: NDArray[np.int64], face_planes: NDArray[np.int64], tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split planes that are linked only in a chain of small steps; the others remain as they are."""
    signs = np.sign(np.einsum("ij,ij->i", features[:, :3], features[first[face_planes], :3]))
    aligned = features * signs[:, None]
    order = np.argsort(face_planes, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(face_planes))[:-1]])
    low = np.minimum.reduceat(aligned[order], starts)
    high = np.maximum.reduceat(aligned[order], starts)
    chained = (high - low).max(axis=1) > 2.0 * tolerance
    if not chained.any():
        return first, face_planes
    links = np.where(chained[face_planes, None], np.floor((aligned - low[face_planes]) / tolerance), 0.0)
    keys = np.concatenate([face_planes[:, None], links], axis=1)
    _, first, face_planes = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first, face_planes.reshape(-1)
