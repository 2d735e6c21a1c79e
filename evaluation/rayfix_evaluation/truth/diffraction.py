"""Paths that bend once round an edge: Keller's cone, and the weights of the uniform theory of diffraction (UTD).

R. G. Kouyoumjian and P. H. Pathak, "A uniform geometrical theory of diffraction for an edge in a perfectly conducting
surface", Proceedings of the IEEE 62 (1974). Faces reflect as the slabs that they are; the terms of the two faces are
joined as in Sionna RT, which follows Hashimoto and others: the coefficient of the lit face weighs its own shadow
boundaries, and where the other face is in the dark, its coefficient is -1.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.special import modfresnelm

from rayfix_evaluation.truth.edges import Edges
from rayfix_evaluation.truth.forward_kernels import visible_through
from rayfix_evaluation.truth.interactions import field_through, sent_field
from rayfix_evaluation.truth.mirrors import MirrorScene
from rayfix_evaluation.truth.walls import Walls
from rayfix_service.measuring.ranging import SPEED_OF_LIGHT

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_NEAR = 1e-9  # m and sine; ends this near to an edge's line, or faces this near to a ray, have no diffracted path


@dataclass(frozen=True, kw_only=True, eq=False)
class DiffractedPaths:
    """Paths with one diffraction and no reflection, sorted by descending gain.

    Attributes
    ----------
    path_length : ndarray of shape (n_paths,), m
    azimuth, zenith : ndarray of shape (n_paths,), rad
        Of the direction from the station.
    gain_db : ndarray of shape (n_paths,), dB
        Power gain relative to one metre of free space, the mean over the polarisations sent.
    num_walls : ndarray of int of shape (n_paths, 2)
        Number of walls passed before and after the edge.
    points : ndarray of shape (n_paths, 3), m
        Where the path meets the edge.
    edges : ndarray of int of shape (n_paths,)
        Index of the edge.
    """

    path_length: Array
    azimuth: Array
    zenith: Array
    gain_db: Array
    num_walls: NDArray[np.int64]
    points: Array
    edges: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.path_length)

    def chosen(self, indices: NDArray[np.int64] | NDArray[np.bool_]) -> "DiffractedPaths":
        """Select paths by their indices, or by a mask."""
        return DiffractedPaths(**{field.name: getattr(self, field.name)[indices] for field in fields(self)})


def diffracted_paths(
    scene: MirrorScene, walls: Walls, edges: Edges, station: Array, point: Array, *, constant_loss_db: float = 6.0
) -> DiffractedPaths:
    """Find the paths of a station to a point by way of one edge.

    Parameters
    ----------
    scene, walls, edges
        The scene, its triangles' walls in their order, and its edges.
    station, point : ndarray of shape (3,), m
    constant_loss_db : float
        Loss of reflections where the walls tell none.
    """
    which, share = _stationary(edges, station, point)
    at = edges.origin[which] + share[:, None] * edges.along[which]
    lit = _lit_first(edges.normals[which], station - at)
    normals = np.where(lit[:, None, None], edges.normals[which], edges.normals[which][:, ::-1])
    triangles = np.where(lit[:, None], edges.triangles[which], edges.triangles[which][:, ::-1])
    sees = np.einsum("ni,ni->n", normals[:, 0], station - at) > _NEAR
    sees &= (np.einsum("nfi,ni->nf", normals, point - at) > _NEAR).any(axis=1)
    sees &= visible_through(scene, station, at) & visible_through(scene, point, at)
    inward = np.where(lit[:, None], edges.inwards[which, 0], edges.inwards[which, 1])
    which, at, normals, inward, triangles = which[sees], at[sees], normals[sees], inward[sees], triangles[sees]
    starts, ends = np.broadcast_to(station, at.shape).copy(), np.broadcast_to(point, at.shape).copy()
    offset = at - starts
    before, after = np.linalg.norm(offset, axis=1), np.linalg.norm(ends - at, axis=1)
    field, walls_before, excess_before = field_through(scene, walls, starts, at, sent_field(offset / before[:, None]))
    bent = _bent(walls, edges.along[which], normals, inward, triangles, (starts, at, ends), constant_loss_db)
    field, walls_after, excess_after = field_through(scene, walls, at, ends, bent @ field)
    power = 0.5 * (np.abs(field) ** 2).sum(axis=(1, 2)) / (before * after * (before + after))
    return DiffractedPaths(
        path_length=before + after + excess_before + excess_after,
        azimuth=np.arctan2(offset[:, 1], offset[:, 0]),
        zenith=np.arctan2(np.hypot(offset[:, 0], offset[:, 1]), offset[:, 2]),
        gain_db=np.asarray(10.0 * np.log10(np.maximum(power, 1e-30))),
        num_walls=np.stack([walls_before, walls_after], axis=1),
        points=at,
        edges=which,
    ).chosen(np.argsort(-power, kind="stable"))


def _stationary(edges: Edges, station: Array, point: Array) -> tuple[NDArray[np.int64], Array]:
    """Edges whose shortest way between two points is within them, and where: the angles to the edge are equal there."""
    reach, distance = [], []
    for end in (station, point):
        apart = end - edges.origin
        on = np.einsum("ni,ni->n", apart, edges.along)
        reach.append(on)
        distance.append(np.linalg.norm(apart - on[:, None] * edges.along, axis=1))
    total = distance[0] + distance[1]
    share = (reach[0] * distance[1] + reach[1] * distance[0]) / np.maximum(total, _NEAR)
    inside = (share > 0.0) & (share < edges.length) & (distance[0] > _NEAR) & (distance[1] > _NEAR)
    which = np.flatnonzero(inside)
    return which, share[which]


def _lit_first(normals: Array, towards: Array) -> NDArray[np.bool_]:
    """Whether the first of two faces is lit from a direction, shape (n,)."""
    return np.asarray(np.einsum("ni,ni->n", normals[:, 0], towards) > _NEAR)


def _bent(
    walls: Walls,
    along: Array,
    normals: Array,
    inward: Array,
    triangles: NDArray[np.int64],
    places: tuple[Array, Array, Array],
    constant_loss_db: float,
) -> ComplexArray:
    """Matrices that turn the field at edges into that of diffracted rays at 1 m, without spreading, shape (n, 3, 3).

    ``places`` are start, edge and end; ``inward`` is the direction in the face 0 away from the edge.
    """
    starts, at, ends = places
    count = len(at)
    wave_number = 2.0 * np.pi * walls.carrier_ghz * 1e9 / SPEED_OF_LIGHT
    before, after = np.linalg.norm(at - starts, axis=1), np.linalg.norm(ends - at, axis=1)
    ray, onward = (at - starts) / before[:, None], (ends - at) / after[:, None]
    # The edge's direction completes the frame of the face 0: normal x edge = inward.
    handed = np.einsum("ni,ni->n", np.cross(normals[:, 0], along), inward)
    edge = along * np.sign(handed)[:, None]
    sine = np.sqrt(np.maximum(1.0 - np.einsum("ni,ni->n", ray, edge) ** 2, _NEAR))
    angle_in = _angle(-ray, edge, inward, normals[:, 0])
    angle_out = _angle(onward, edge, inward, normals[:, 0])
    interior = np.arccos(np.clip(-np.einsum("ni,ni->n", normals[:, 0], normals[:, 1]), -1.0, 1.0))
    exterior = 2.0 * np.pi - interior
    terms = _terms(angle_in, angle_out, exterior / np.pi, wave_number * before * after / (before + after) * sine**2)
    factor = -np.exp(-0.25j * np.pi) / (2.0 * exterior / np.pi * np.sqrt(2.0 * np.pi * wave_number) * sine)
    own, other = (terms[0] - terms[3]) * factor, (terms[1] - terms[2]) * factor
    matrix = np.zeros((count, 2, 2), np.complex128)
    dark = exterior > np.pi + angle_in
    for face, weight in ((0, own), (1, other)):
        normal = normals[:, face]
        cosine = np.minimum(np.abs(np.einsum("ni,ni->n", ray, normal)), 1.0)
        thickness = walls.thickness[triangles[:, face]]
        both = walls.reflection(triangles[:, face], cosine, thickness, constant_loss_db=constant_loss_db)
        reflected = _reflection_matrix(ray, edge, normal, both)
        if face == 1:
            reflected = np.where(dark[:, None, None], -np.eye(2), reflected)
        matrix += weight[:, None, None] * reflected
    # The fields at the shadow boundary have the same components in the frame of the diffracted ray.
    frame_in, frame_out = _edge_frame(ray, edge), _edge_frame(onward, -edge)
    return np.asarray(np.einsum("nai,nab,nbj->nij", frame_out, matrix, frame_in))


def _edge_frame(ray: Array, edge: Array) -> Array:
    """Directions across rays, the first one also across the edge, shape (n, 2, 3)."""
    first = _unit(np.cross(ray, edge))
    return np.stack([first, np.cross(ray, first)], axis=1)


def _reflection_matrix(ray: Array, edge: Array, normal: Array, both: ComplexArray) -> ComplexArray:
    """Reflection at a face between the frames of the edge, before it and at its shadow boundary, shape (n, 2, 2)."""
    mirrored = ray - 2.0 * np.einsum("ni,ni->n", ray, normal)[:, None] * normal
    side = np.cross(ray, normal)
    upright = np.linalg.norm(side, axis=1) < _NEAR
    side[upright] = edge[upright]
    side = _unit(side)
    frame_in, frame_out = _edge_frame(ray, edge), _edge_frame(mirrored, -edge)
    face_in = np.stack([side, np.cross(ray, side)], axis=1)
    face_out = np.stack([side, np.cross(mirrored, side)], axis=1)
    to_face = np.einsum("nai,nbi->nab", face_in, frame_in)
    from_face = np.einsum("nai,nbi->nab", frame_out, face_out)
    return np.asarray(from_face @ (both[:, :, None] * to_face))


def _angle(towards: Array, edge: Array, inward: Array, normal: Array) -> Array:
    """Angle about the edge from the face 0 to a direction, in [0, 2 pi)."""
    flat = towards - np.einsum("ni,ni->n", towards, edge)[:, None] * edge
    angle = np.arctan2(np.einsum("ni,ni->n", flat, normal), np.einsum("ni,ni->n", flat, inward))
    return np.asarray(np.mod(angle, 2.0 * np.pi))


def _terms(angle_in: Array, angle_out: Array, wedge: Array, distance: Array) -> list[ComplexArray]:
    """Products of cotangent and transition function: for the angles' difference (+, -) and their sum (+, -)."""
    found = []
    for beta in (angle_out - angle_in, angle_out + angle_in):
        for sign in (1.0, -1.0):
            turns = np.round((beta + sign * np.pi) / (2.0 * np.pi * wedge))
            # Distance from the shadow boundary; where it is 0, cotangent and transition function have a finite product.
            half = np.pi * wedge * turns - 0.5 * beta
            opening = 2.0 * np.cos(half) ** 2
            off = np.where(np.abs(opening) < 1e-14, 1e-14, opening)
            argument = (np.pi + sign * beta) / (2.0 * wedge)
            argument = np.where(np.abs(np.sin(argument)) < 1e-8, argument + 1e-8, argument)
            found.append(_transition(distance * off) / np.tan(argument))
    return found


def _transition(x: Array) -> ComplexArray:
    """Kouyoumjian's and Pathak's transition function F."""
    root = np.sqrt(x)
    return np.asarray(2j * root * np.exp(1j * x) * modfresnelm(root)[0])


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
