"""Ground truth: every specular path between a station and a point (image method with visibility).

It shares no code with the ray launcher, which permits testing each against the other. Angles, lengths and frames
are those of ``docs/conventions.md``.

A path leaves the station, is reflected at up to ``max_reflections`` planes and ends at the point. Coplanar triangles
are one mirror; it reflects on both sides, but only inside its triangles. A path exists when every bounce hits a
triangle of its plane, the vertices before and after the bounce lie on the same side of it, and no opaque triangle
crosses a segment between its ends. Walls that let signals through do not turn a path: they weaken it and make it longer
(:class:`~rayfix_evaluation.truth.walls.Walls`).
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_evaluation.truth.diffraction import DiffractedPaths, diffracted_paths
from rayfix_evaluation.truth.edges import Edges, find_edges
from rayfix_evaluation.truth.forward_kernels import trace_paths, visible
from rayfix_evaluation.truth.images import image_tree, mirror_scene
from rayfix_evaluation.truth.interactions import Interactions, Polarisation, interactions
from rayfix_evaluation.truth.mirrors import ImageTree, MirrorScene
from rayfix_evaluation.truth.walls import Walls

__all__ = ["ForwardSolver", "Paths", "StationSolver"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Paths:
    """All paths between one station and one point, sorted by descending gain.

    Attributes
    ----------
    path_length : ndarray of shape (n_paths,), m
        Unfolded lengths, and what the slabs of walls add to them.
    azimuth : ndarray of shape (n_paths,), rad
        Azimuth of the direction from the station along the path's first segment, in (-pi, pi].
    zenith : ndarray of shape (n_paths,), rad
        Zenith of the same direction, in [0, pi].
    num_reflections : ndarray of int of shape (n_paths,)
        Number of bounces; 0 is the straight path, which is the line of sight if it passes no wall.
    num_walls : ndarray of int of shape (n_paths,)
        Number of walls passed.
    gain_db : ndarray of shape (n_paths,), dB
        Power gain relative to one metre of free space: ``-20 log10`` of the unfolded length minus the losses of the
        bounces and the walls.
    vertices : ndarray of shape (n_paths, max_reflections + 2, 3), m
        Station, reflection points, point; unused rows repeat the point.
    crossings : ndarray of shape (n_paths, most_walls, 3), m
        Where the path enters each wall, in the order from the station; unused rows repeat the point.
    """

    path_length: NDArray[np.float64]
    azimuth: NDArray[np.float64]
    zenith: NDArray[np.float64]
    num_reflections: NDArray[np.int64]
    num_walls: NDArray[np.int64]
    gain_db: NDArray[np.float64]
    vertices: NDArray[np.float64]
    crossings: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.path_length)

    @property
    def line_of_sight(self) -> NDArray[np.bool_]:
        """Whether each path is the line of sight: straight, through no wall; shape (n_paths,)."""
        return np.asarray((self.num_reflections == 0) & (self.num_walls == 0))

    def only(self, index: int) -> "Paths":
        """Select one path, as a set with one element."""
        return self.chosen(np.array([index]))

    def chosen(self, indices: NDArray[np.int64] | NDArray[np.bool_]) -> "Paths":
        """Select paths by their indices, or by a mask."""
        return Paths(**{field.name: getattr(self, field.name)[indices] for field in fields(self)})


@dataclass(frozen=True, kw_only=True, eq=False)
class ForwardSolver:
    """Finds the paths in one scene; build it with :meth:`from_mesh`.

    Attributes
    ----------
    scene : MirrorScene
        Mirror planes and triangles.
    max_reflections : int
        Largest number of reflections of a path.
    max_path_length : float
        Largest length of a path, m.
    reflection_loss_db : float
        Loss of each bounce where the walls tell none, dB.
    walls : Walls or None
        What the scene's triangles are made of, in their order; None if all are opaque and have the constant loss.
    max_loss_db : float
        Paths that bounces and walls weaken by more than this are left out, dB.
    polarisation : {"mixed", "kept"}
        How the losses of both polarisations are averaged.
    edges : Edges or None
        Edges that bend paths, which :meth:`StationSolver.diffracted` finds; None if they were not asked for.
    """

    scene: MirrorScene
    max_reflections: int
    max_path_length: float
    reflection_loss_db: float
    walls: Walls | None = None
    max_loss_db: float = np.inf
    polarisation: Polarisation = "mixed"
    edges: Edges | None = None

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        max_reflections: int = 3,
        max_path_length: float = 60.0,
        reflection_loss_db: float = 6.0,
        walls: Walls | None = None,
        max_loss_db: float = np.inf,
        polarisation: Polarisation = "mixed",
        diffraction: bool = False,
    ) -> "ForwardSolver":
        """Merge a mesh's coplanar triangles into mirrors and prepare the visibility tests.

        Parameters
        ----------
        vertices : ndarray of shape (n_vertices, 3), m
            Vertices of the mesh.
        faces : ndarray of int of shape (n_faces, 3)
            Vertex indices of the triangles, in any order and orientation.
        max_reflections : int
            Largest number of reflections of a path.
        max_path_length : float
            Largest length of a path, m.
        reflection_loss_db : float
            Loss of each bounce where the walls tell none, dB.
        walls : Walls, optional
            What the faces are made of; all are opaque and have the constant loss when left out.
        max_loss_db : float
            Paths that bounces and walls weaken by more than this are left out, dB.
        polarisation : {"mixed", "kept"}
            How the losses of both polarisations are averaged: at each interaction, as tables do, or at the transmitter
            only.
        diffraction : bool
            Whether to prepare the edges that bend paths. It needs walls, which state the carrier.

        Returns
        -------
        ForwardSolver
            The solver of this scene.

        Raises
        ------
        SceneError
            If the mesh has no triangle with an area or a vertex that is not finite.
        ValueError
            If a setting is out of range.
        """
        if max_reflections < 0:
            raise ValueError(f"max_reflections is {max_reflections}; it must not be negative")
        if not max_path_length > 0.0:
            raise ValueError(f"max_path_length is {max_path_length} m; it must be positive")
        if not max_loss_db > 0.0:
            raise ValueError(f"max_loss_db is {max_loss_db} dB; it must be positive")
        triangles = np.asarray(faces, dtype=np.int64)
        if walls is not None and len(walls) != len(triangles):
            raise ValueError(f"the walls have {len(walls)} faces and the mesh {len(triangles)}; they must be the same")
        if diffraction and walls is None:
            raise ValueError("diffraction depends on the carrier; give walls, which state it")
        places = np.asarray(vertices, dtype=np.float64)
        scene = mirror_scene(places, triangles, walls)
        return cls(
            scene=scene,
            max_reflections=max_reflections,
            # An int would compile the kernels a second time.
            max_path_length=float(max_path_length),
            reflection_loss_db=float(reflection_loss_db),
            walls=None if walls is None else walls.of_faces(scene.triangle_faces),
            max_loss_db=float(max_loss_db),
            polarisation=polarisation,
            edges=find_edges(scene, places[triangles][scene.triangle_faces]) if diffraction else None,
        )

    @property
    def num_planes(self) -> int:
        """Number of mirror planes."""
        return len(self.scene.normals)

    def station(self, position: ArrayLike) -> "StationSolver":
        """Build the image sources of a station once, for many points.

        Parameters
        ----------
        position : ndarray of shape (3,), m
            Position of the station.

        Returns
        -------
        StationSolver
            Solver of this station's paths.
        """
        origin = _position(position, "station")
        tree = image_tree(
            self.scene, origin, max_reflections=self.max_reflections, max_path_length=self.max_path_length
        )
        return StationSolver(solver=self, position=origin, tree=tree)

    def paths(self, station: ArrayLike, point: ArrayLike) -> Paths:
        """Find all paths between a station and a point; :meth:`station` is faster for many points.

        Parameters
        ----------
        station : ndarray of shape (3,), m
            Position of the station.
        point : ndarray of shape (3,), m
            Position of the transmitter.

        Returns
        -------
        Paths
            Sorted by descending gain; empty if there is none.
        """
        return self.station(station).paths(point)

    def line_of_sight(self, station: ArrayLike, points: ArrayLike) -> NDArray[np.bool_]:
        """Find the points with a line of sight to a station, at any distance.

        Parameters
        ----------
        station : ndarray of shape (3,), m
            Position of the station.
        points : ndarray of shape (n, 3), m
            Positions to test.

        Returns
        -------
        ndarray of bool of shape (n,)
            True where no triangle crosses the straight line.
        """
        ends = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        seen: NDArray[np.bool_] = visible(self.scene, _position(station, "station"), ends)
        return seen


@dataclass(frozen=True, kw_only=True, eq=False)
class StationSolver:
    """Finds the paths of one station; build it with :meth:`ForwardSolver.station`.

    Attributes
    ----------
    solver : ForwardSolver
        Scene and settings.
    position : ndarray of shape (3,), m
        Position of the station.
    tree : ImageTree
        Its image sources.
    """

    solver: ForwardSolver
    position: NDArray[np.float64]
    tree: ImageTree

    def paths(self, point: ArrayLike) -> Paths:
        """Find all paths between the station and a point.

        Parameters
        ----------
        point : ndarray of shape (3,), m
            Position of the transmitter.

        Returns
        -------
        Paths
            Sorted by descending gain; empty if there is none. A point within a micrometre of the station has
            no direct path, because its direction would be undefined.
        """
        solver = self.solver
        end = _position(point, "point")
        sequences, vertices, unfolded = trace_paths(
            solver.scene, self.tree, end, solver.max_reflections, solver.max_path_length
        )
        met = self._interactions(sequences, vertices)
        offset = unfolded - self.position
        horizontal = np.hypot(offset[:, 0], offset[:, 1])
        length = np.hypot(horizontal, offset[:, 2])
        azimuth = np.arctan2(offset[:, 1], offset[:, 0])
        azimuth[azimuth <= -np.pi] = np.pi  # arctan2 of -0.0
        gain = -20.0 * np.log10(length) + met.gain_db
        order = np.argsort(-gain, kind="stable")
        order = order[met.gain_db[order] >= -solver.max_loss_db]
        return Paths(
            path_length=length + met.excess_length,
            azimuth=azimuth,
            zenith=np.arctan2(horizontal, offset[:, 2]),
            num_reflections=(sequences >= 0).sum(axis=1),
            num_walls=met.num_walls,
            gain_db=gain,
            vertices=vertices,
            crossings=met.crossings,
        ).chosen(order)

    def diffracted(self, point: ArrayLike) -> DiffractedPaths:
        """Find the paths to a point that bend once round an edge and are not reflected.

        Parameters
        ----------
        point : ndarray of shape (3,), m
            Position of the transmitter.

        Returns
        -------
        DiffractedPaths
            Sorted by descending gain; through walls that let signals through, in any number.

        Raises
        ------
        ValueError
            If the solver was made without diffraction.
        """
        solver = self.solver
        if solver.edges is None or solver.walls is None:
            raise ValueError("this solver has no edges; make it with diffraction=True")
        return diffracted_paths(
            solver.scene,
            solver.walls,
            solver.edges,
            self.position,
            _position(point, "point"),
            constant_loss_db=solver.reflection_loss_db,
        )

    def _interactions(self, sequences: NDArray[np.int64], vertices: NDArray[np.float64]) -> Interactions:
        solver = self.solver
        return interactions(
            solver.scene,
            solver.walls,
            sequences,
            vertices,
            constant_loss_db=solver.reflection_loss_db,
            polarisation=solver.polarisation,
        )


def _position(position: ArrayLike, name: str) -> NDArray[np.float64]:
    """Check a position and return it as an array of shape (3,)."""
    array = np.array(position, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"the {name} is {position!r}; it must be three finite coordinates in metres")
    return array
