"""The digital twin: scene, mirror planes, ray engine and free space, checked against the site."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.engine import FAR, EmbreeEngine, RayEngine
from rayfix_offline.scene.room import room_scene, wall_remarks
from rayfix_offline.scene.scene import Scene, load_scene
from rayfix_offline.scene.walls import walls_of
from rayfix_offline.site import OFF_WALL, SiteFile
from rayfix_offline.twin.cleaning import find_duplicates
from rayfix_offline.twin.enclosures import find_enclosures
from rayfix_offline.twin.findings import (
    Finding,
    error,
    file_findings,
    material_findings,
    mesh_findings,
    partition_findings,
    reach_findings,
    size_findings,
    station_findings,
    wall_findings,
)
from rayfix_offline.twin.mesh import Mesh
from rayfix_offline.twin.partitions import find_partitions
from rayfix_offline.twin.planes import Planes, merge_coplanar
from rayfix_offline.twin.settings import TwinSettings
from rayfix_offline.twin.solids import map_free_space, sealed_space, solid_faces, split_parts
from rayfix_offline.twin.surfaces import join_facets
from rayfix_tables.errors import SceneError
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.gaussians.compilation import watch_compilation


@dataclass(frozen=True, kw_only=True)
class Twin:
    """A scene prepared for ray launching.

    Attributes
    ----------
    site : SiteFile
        The site, with stations in the frame of ``scene``.
    scene : Scene
        The scene in the table's frame, which is relative to ``origin``.
    origin : ndarray of shape (3,), m
        Origin of the table's frame in the frame of the scene file; zero except for scenes on map coordinates.
    solid : ndarray of int32, shape (n_faces,)
        Closed part, no building, that each triangle belongs to; -1 for sheets and shells.
    outward : ndarray of shape (n_faces, 3)
        Unit normals of the triangles, of solids the outward ones.
    """

    site: SiteFile
    scene: Scene
    origin: NDArray[np.float64]
    solid: NDArray[np.int32]
    outward: NDArray[np.float64]
    planes: Planes
    engine: RayEngine
    free_space: FreeSpace
    closed: bool
    findings: tuple[Finding, ...]


def prepare_twin(site: SiteFile, folder: Path, settings: TwinSettings | None = None) -> Twin:
    """Load and check the scene of a site.

    Parameters
    ----------
    folder : Path
        The site file's; the scene's path is relative to it.
    settings : TwinSettings, optional

    Raises
    ------
    SceneError
        When the scene cannot be read. Problems of a readable scene are in the twin's findings.
    """
    if site.room is not None:
        scene = room_scene(site.room)
        settings = settings or TwinSettings()
        # Stations on walls are a millimetre off them, which elsewhere counts as touching.
        settings = replace(settings, touch=min(settings.touch, 0.5 * OFF_WALL))
        return prepare_scene(site, replace(scene, remarks=wall_remarks(site)), settings)
    assert site.site.scene is not None
    scene = load_scene(folder / site.site.scene, unit=site.site.scene_unit, up=site.site.scene_up)
    return prepare_scene(site, scene, settings)


def prepare_scene(site: SiteFile, scene: Scene, settings: TwinSettings | None = None) -> Twin:
    """Prepare the twin of a scene that is already loaded; see :func:`prepare_twin`."""
    watch_compilation()
    settings = settings or TwinSettings()
    origin = table_origin(scene)
    site, scene = site.moved(-origin), scene.moved(-origin)
    mesh = Mesh(scene=scene, weld=settings.weld)
    duplicates = find_duplicates(mesh)
    mesh = mesh.without(duplicates.redundant)
    scene, parts = mesh.scene, split_parts(mesh)
    stations = np.array([station.position_m for station in site.stations])
    enclosures = find_enclosures(scene, parts, stations, settings)
    solids = [part.closed and not shell for part, shell in zip(parts, enclosures.enclosing, strict=True)]
    solid, outward = solid_faces(mesh, parts, solids)
    free_space = map_free_space(
        scene,
        solids=[part for part, is_solid in zip(parts, solids, strict=True) if is_solid],
        rooms=[part for part, is_room in zip(parts, enclosures.rooms, strict=True) if is_room],
        voxel_size=settings.voxel_size,
        max_voxels=settings.max_voxels,
    )
    closed = bool(enclosures.rooms.any())
    if not closed:
        sealed = sealed_space(free_space, stations)
        closed, free_space = sealed is not None, sealed or free_space
    findings = [
        *size_findings(site, scene),
        *reach_findings(site, scene),
        *file_findings(scene),
        *mesh_findings(scene, duplicates, [part.moved(origin) for part in parts], enclosures),
        *material_findings(site, scene),
        *wall_findings(site, scene),
        *partition_findings(
            site,
            scene,
            find_partitions(scene, free_space, closed=closed),
            walls_of(site, scene, solid, outward).passable,
        ),
        *station_findings(site, scene, parts, enclosures, touch=settings.touch, origin=origin),
    ]
    if not free_space.free.any():
        problem = "the scene has no free space: every voxel lies in a solid or outside"
        findings.append(error("free space", problem, "check for an inverted room"))
    planes = merge_coplanar(scene.triangles, tolerance=settings.plane_tolerance, rounding=settings.plane_rounding)
    return Twin(
        site=site,
        scene=scene,
        origin=origin,
        solid=solid,
        outward=outward,
        planes=join_facets(mesh, planes, surface_angle=settings.surface_angle, facet_size=settings.facet_size),
        engine=EmbreeEngine(scene.triangles),
        free_space=free_space,
        closed=closed,
        findings=tuple(findings),
    )


def table_origin(scene: Scene) -> NDArray[np.float64]:
    """Origin of the table's frame, shape (3,), m: zero, or for a scene far from it the scene's middle in whole metres.

    It is also zero along axes where the middle is nearer to zero than the scene's size. Along the others the
    scene's coordinates are within a factor of 2 of it, so that subtracting and adding it is exact.
    """
    low, high = scene.bounds
    if np.abs(scene.bounds).max() <= FAR:
        return np.zeros(3)
    middle = np.round(0.5 * (low + high))
    return np.where(np.abs(middle) > high - low, middle, 0.0)


def refuse_errors(twin: Twin) -> None:
    """Raise one exception for all findings that stop a build.

    Raises
    ------
    SceneError
        When the twin has findings of severity "error".
    """
    errors = [finding.message for finding in twin.findings if finding.severity == "error"]
    if errors:
        raise SceneError("; ".join(errors))
