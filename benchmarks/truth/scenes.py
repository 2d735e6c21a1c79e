"""Scenes of the comparisons with Sionna RT: the bundled hall and office, a site file, or a mesh alone."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix.example.files import Example, write_example
from rayfix_evaluation.truth.scene_walls import walls_of_twin
from rayfix_evaluation.truth.walls import Walls
from rayfix_offline.scene.materials import itu_name
from rayfix_offline.scene.scene import load_scene
from rayfix_offline.site import SiteFile, read_site
from rayfix_offline.twin.twin import prepare_twin
from rayfix_tables.freespace import FreeSpace

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedScene:
    """A scene as both solvers take it.

    Attributes
    ----------
    vertices : ndarray of shape (n_vertices, 3), m
    faces : ndarray of int of shape (n_faces, 3)
    stations : ndarray of shape (n, 3), m
    walls : Walls or None
        For the forward solver; None if every face is opaque and reflects with one loss. Without excess lengths, which
        Sionna RT leaves out.
    materials : tuple of str
        ITU material of each face, for Sionna RT.
    thickness : dict of str to float, m
        Thickness of the materials.
    free_space : FreeSpace or None
        Where points may be; the box of the scene if None.
    """

    vertices: Array
    faces: NDArray[np.int64]
    stations: Array
    walls: Walls | None = None
    materials: tuple[str, ...] | None = None
    thickness: dict[str, float] | None = None
    free_space: FreeSpace | None = None

    @property
    def passes(self) -> bool:
        """Whether any face lets signals through."""
        return self.walls is not None and bool(self.walls.lets_through.any())

    def points(self, count: int, rng: np.random.Generator) -> Array:
        """Draw points evenly, shape (count, 3), m; without a free space some may lie within solids."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        found = rng.uniform(low + 0.05 * (high - low), high - 0.05 * (high - low), (20 * count, 3))
        if self.free_space is not None:
            found = found[self.free_space.contains(found)]
        return found[:count]


def example_scene(example: Example, *, carrier_ghz: float | None = None) -> ComparedScene:
    """Return a bundled example; the hall is compared without materials."""
    with tempfile.TemporaryDirectory() as folder:
        return site_scene(write_example(folder, example=example), carrier_ghz=carrier_ghz)


def site_scene(path: Path, *, carrier_ghz: float | None = None) -> ComparedScene:
    """Return the scene of a site file, at its carrier or another."""
    site = read_site(path)
    if carrier_ghz is not None:
        site = _at_carrier(site, carrier_ghz)
    twin = prepare_twin(site, path.parent)
    walls = replace(walls_of_twin(twin), excess_length=False)
    names = np.array([itu_name(name) or "metal" for name in twin.scene.materials])[twin.scene.face_materials]
    thickness = {}
    for name in sorted(set(names.tolist())):
        known = np.unique(walls.thickness[(names == name) & np.isfinite(walls.thickness)])
        if len(known) > 1:
            raise ValueError(f"{path}: sheets of {name} have {len(known)} thicknesses; Sionna RT is given one")
        if len(known):
            thickness[name] = float(known[0])
    return ComparedScene(
        vertices=twin.scene.vertices + twin.origin,
        faces=twin.scene.faces.astype(np.int64),
        stations=np.array([station.position_m for station in site.stations]),
        walls=walls,
        materials=tuple(names.tolist()),
        thickness=thickness,
        free_space=twin.free_space.moved(twin.origin),
    )


def mesh_scene(path: Path, num_stations: int, rng: np.random.Generator) -> ComparedScene:
    """Return a mesh of opaque faces, with stations drawn from its box."""
    scene = load_scene(path)
    bare = ComparedScene(vertices=scene.vertices, faces=scene.faces.astype(np.int64), stations=np.empty((0, 3)))
    return replace(bare, stations=bare.points(num_stations, rng))


def _at_carrier(site: SiteFile, carrier_ghz: float) -> SiteFile:
    return site.model_copy(update={"propagation": site.propagation.model_copy(update={"carrier_ghz": carrier_ghz})})
