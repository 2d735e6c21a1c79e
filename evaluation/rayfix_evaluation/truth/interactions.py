"""What bounces and passages do to paths: the power that is left, and the length that slabs add."""

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.forward_kernels import hit_triangles
from rayfix_evaluation.truth.fresnel import FLOOR_DB
from rayfix_evaluation.truth.mirrors import MirrorScene
from rayfix_evaluation.truth.passages import depths_behind, walls_on_paths
from rayfix_evaluation.truth.walls import Walls

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

Polarisation = Literal["mixed", "kept"]
"""How the polarisations are averaged: at every interaction, or at the transmitter only.

``"mixed"`` is the table's model: each interaction passes the mean of the powers of its two polarisations. ``"kept"``
follows the field from interaction to interaction and averages over the polarisation that is sent, with a receiver of
any.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Interactions:
    """What happens to paths on their way.

    Attributes
    ----------
    gain_db : ndarray of shape (n_paths,), dB
        Power that is left, relative to free space.
    excess_length : ndarray of shape (n_paths,), m
        Length that slabs add.
    num_walls : ndarray of int of shape (n_paths,)
        Walls passed.
    crossings : ndarray of shape (n_paths, most, 3), m
        Where walls are entered, in order; unused rows repeat the path's end.
    """

    gain_db: Array
    excess_length: Array
    num_walls: Indices
    crossings: Array


def interactions(
    scene: MirrorScene,
    walls: Walls | None,
    sequences: Indices,
    vertices: Array,
    *,
    constant_loss_db: float,
    polarisation: Polarisation = "mixed",
) -> Interactions:
    """Find the walls that paths pass through, and the loss of these and of the bounces.

    Parameters
    ----------
    scene : MirrorScene
    walls : Walls or None
        Of the scene's triangles, in their order; all have the constant loss and are opaque if None.
    sequences : ndarray of int of shape (n_paths, max_reflections)
        Planes from the station to the point, then -1.
    vertices : ndarray of shape (n_paths, max_reflections + 2, 3), m
        Station, hits, point.
    constant_loss_db : float
        Loss of bounces where neither a loss nor a permittivity is known.
    polarisation : {"mixed", "kept"}
    """
    count = len(sequences)
    path, bounce = np.nonzero(sequences >= 0)
    if walls is None:
        return Interactions(
            gain_db=-constant_loss_db * np.bincount(path, minlength=count).astype(np.float64),
            excess_length=np.zeros(count),
            num_walls=np.zeros(count, np.int64),
            crossings=np.empty((count, 0, 3)),
        )
    incoming = _unit(vertices[path, bounce + 1] - vertices[path, bounce])
    triangles = hit_triangles(scene, sequences, vertices)[path, bounce]
    normals = scene.normals[sequences[path, bounce]]
    cosine = np.minimum(np.abs(np.einsum("ij,ij->i", incoming, normals)), 1.0)
    thickness = walls.thickness[triangles]
    closed = scene.triangle_solids[triangles] >= 0
    if closed.any():
        thickness = np.where(closed, depths_behind(scene, triangles, vertices[path, bounce + 1].copy()), thickness)
    bounces = _Events(
        path=path,
        place=np.stack([bounce + 1.0, np.zeros(len(path))], axis=1),
        incoming=incoming,
        normal=normals,
        coefficients=walls.reflection(triangles, cosine, thickness, constant_loss_db=constant_loss_db),
        reflects=np.ones(len(path), np.bool_),
    )
    passages, places, lengths = _passages(scene, walls, sequences, vertices)
    num_walls = np.bincount(passages.path, minlength=count)
    excess = np.zeros(count)
    np.add.at(excess, passages.path, lengths)
    rank = np.arange(len(places)) - np.repeat(np.cumsum(num_walls) - num_walls, num_walls)
    crossings = np.repeat(vertices[:, -1:], int(num_walls.max(initial=0)), axis=1)
    crossings[passages.path, rank] = places
    power = _power(bounces, passages, count) if polarisation == "mixed" else _kept_power(bounces, passages, count)
    return Interactions(
        gain_db=np.asarray(10.0 * np.log10(np.maximum(power, 10.0 ** (_LEAST_DB / 10.0)))),
        excess_length=excess,
        num_walls=num_walls,
        crossings=crossings,
    )


_LEAST_DB = 4.0 * FLOOR_DB
"""Smallest gain of a path, dB, to keep gains finite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Events:
    """Interactions of many paths: ``place`` orders those of a path; ``coefficients`` of shape (n, 2)."""

    path: Indices
    place: Array
    incoming: Array
    normal: Array
    coefficients: NDArray[np.complex128]
    reflects: NDArray[np.bool_]


def field_through(
    scene: MirrorScene, walls: Walls, starts: Array, ends: Array, field: NDArray[np.complex128]
) -> tuple[NDArray[np.complex128], NDArray[np.int64], Array]:
    """Follow fields along straight segments through walls.

    Parameters
    ----------
    scene, walls
        As in :func:`interactions`.
    starts, ends : ndarray of shape (n, 3), m
    field : ndarray of complex of shape (n, 3, 2)
        Of two polarisations, across the segments.

    Returns
    -------
    field : ndarray of complex of shape (n, 3, 2)
    num_walls : ndarray of int of shape (n,)
    excess_length : ndarray of shape (n,), m
    """
    vertices = np.stack([starts, ends], axis=1)
    passages, _, lengths = _passages(scene, walls, np.full((len(starts), 0), -1), vertices)
    excess = np.zeros(len(starts))
    np.add.at(excess, passages.path, lengths)
    return _followed(field, passages), np.bincount(passages.path, minlength=len(starts)), excess


def _passages(scene: MirrorScene, walls: Walls, sequences: Indices, vertices: Array) -> tuple[_Events, Array, Array]:
    """Walls that paths pass, where they are entered, and the lengths that they add."""
    where, found = walls_on_paths(scene, sequences, vertices)
    passed, segment, entered = where.T
    thickness = np.where(np.isnan(found[:, 4]), walls.thickness[entered], found[:, 4])
    start = vertices[passed, segment]
    events = _Events(
        path=passed,
        place=np.stack([segment.astype(np.float64), np.linalg.norm(found[:, :3] - start, axis=1)], axis=1),
        incoming=_unit(vertices[passed, segment + 1] - start),
        normal=scene.triangle_normals[entered],
        coefficients=walls.transmission(entered, found[:, 3], thickness),
        reflects=np.zeros(len(passed), np.bool_),
    )
    return events, found[:, :3], walls.excess(entered, found[:, 3], thickness)


def _power(bounces: _Events, passages: _Events, count: int) -> Array:
    """Product of the interactions' mean powers, shape (n_paths,)."""
    power = np.ones(count)
    for events in (bounces, passages):
        mean = (np.abs(events.coefficients) ** 2).mean(axis=1)
        if events is bounces:
            mean = np.clip(mean, 10.0 ** (FLOOR_DB / 10.0), 1.0)
        np.multiply.at(power, events.path, mean)
    return power


def _kept_power(bounces: _Events, passages: _Events, count: int) -> Array:
    """Power of a field that is followed along each path, the mean over the polarisations sent, shape (n_paths,)."""
    names = [field.name for field in fields(_Events)]
    events = _Events(**{name: np.concatenate([getattr(bounces, name), getattr(passages, name)]) for name in names})
    numbers = np.bincount(events.path, minlength=count)
    met = np.flatnonzero(numbers)
    field = np.zeros((count, 3, 2), np.complex128)
    first = events.incoming[np.lexsort((events.place[:, 1], events.place[:, 0], events.path))]
    field[met] = sent_field(first[(np.cumsum(numbers) - numbers)[met]])
    power = 0.5 * (np.abs(_followed(field, events)) ** 2).sum(axis=(1, 2))
    return np.where(numbers > 0, power, 1.0)


def sent_field(headings: Array) -> NDArray[np.complex128]:
    """Fields of two polarisations across directions of shape (n, 3); shape (n, 3, 2)."""
    across = _unit(np.cross(headings, np.eye(3)[np.argmin(np.abs(headings), axis=1)]))
    return np.stack([across, np.cross(headings, across)], axis=2).astype(np.complex128)


def _followed(field: NDArray[np.complex128], events: _Events) -> NDArray[np.complex128]:
    """Fields of shape (n_paths, 3, 2) after all their interactions, in the paths' order."""
    count = len(field)
    order = np.lexsort((events.place[:, 1], events.place[:, 0], events.path))
    path = events.path[order]
    incoming, normal = events.incoming[order], events.normal[order]
    coefficients, reflects = events.coefficients[order], events.reflects[order]
    numbers = np.bincount(path, minlength=count)
    rank = np.arange(len(path)) - np.repeat(np.cumsum(numbers) - numbers, numbers)
    field = field.copy()
    for step in range(int(numbers.max(initial=0))):
        at = np.flatnonzero(rank == step)
        ray, axis, which = incoming[at], normal[at], path[at]
        side = np.cross(ray, axis)
        upright = np.linalg.norm(side, axis=1) < 1e-9  # any plane is that of incidence
        side[upright] = np.cross(ray[upright], np.eye(3)[np.argmin(np.abs(ray[upright]), axis=1)])
        side = _unit(side)
        onward = ray - 2.0 * np.einsum("ij,ij->i", ray, axis)[:, None] * axis
        onward = np.where(reflects[at][:, None], onward, ray)
        perpendicular = np.einsum("ij,ijk->ik", side, field[which]) * coefficients[at, :1]
        parallel = np.einsum("ij,ijk->ik", np.cross(ray, side), field[which]) * coefficients[at, 1:]
        out = np.cross(onward, side)
        field[which] = side[:, :, None] * perpendicular[:, None] + out[:, :, None] * parallel[:, None]
    return field


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
