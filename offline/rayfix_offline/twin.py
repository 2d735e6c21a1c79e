"""The digital twin, ready for rays: scene, mirror planes, ray engine and free space, checked against the site."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.engine import EmbreeEngine, RayEngine
from rayfix_offline.materials import ITU_MATERIALS, complex_permittivity, itu_name
from rayfix_offline.planes import Planes, merge_coplanar
from rayfix_offline.scene import Scene, load_scene
from rayfix_offline.site import SiteFile
from rayfix_offline.solids import Part, find_enclosures, map_free_space, split_parts, touched
from rayfix_offline.surfaces import join_facets
from rayfix_offline.topology import find_topology
from rayfix_tables.errors import SceneError
from rayfix_tables.freespace import FreeSpace

VOXEL_SIZE = 0.1
"""Edge of a voxel of the free space, m."""

LARGE_SCENE, SMALL_SCENE = 1000.0, 1.0
"""A scene larger or smaller than this has probably another unit, m."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something about the site that its author should know.

    Attributes
    ----------
    severity : {"error", "warning"}
        An error stops the build.
    message : str
        What is wrong, where, and what to do about it.
    """

    severity: Literal["error", "warning"]
    message: str


@dataclass(frozen=True, kw_only=True)
class Twin:
    """A scene that rays can be launched in."""

    scene: Scene
    planes: Planes
    engine: RayEngine
    free_space: FreeSpace
    closed: bool
    findings: tuple[Finding, ...]


def prepare_twin(site: SiteFile, folder: Path) -> Twin:
    """Load and check the scene of a site.

    Parameters
    ----------
    folder : Path
        The site file's; the scene's path is relative to it.

    Raises
    ------
    SceneError
        When the scene cannot be read. What is wrong with a readable scene is in the twin's findings.
    """
    return prepare_scene(site, load_scene(folder / site.site.scene, unit=site.site.scene_unit, up=site.site.scene_up))


def prepare_scene(site: SiteFile, scene: Scene) -> Twin:
    """Check a scene that is loaded already; see :func:`prepare_twin`."""
    topology = find_topology(scene)
    parts = split_parts(scene, topology)
    stations = np.array([station.position_m for station in site.stations])
    enclosing, inside = find_enclosures(scene, parts, stations)
    free_space = map_free_space(scene, parts, enclosing, voxel_size=VOXEL_SIZE)
    findings = [
        *_scene_findings(site, scene, parts, enclosing),
        *_material_findings(site, scene),
        *_station_findings(site, scene, parts, enclosing, inside),
    ]
    if not free_space.free.any():
        message = "the scene has no free space: every voxel lies in a solid or outside; check for an inverted room"
        findings.append(Finding(severity="error", message=message))
    return Twin(
        scene=scene,
        planes=join_facets(scene.triangles, merge_coplanar(scene.triangles), topology),
        engine=EmbreeEngine(scene.triangles),
        free_space=free_space,
        closed=bool(enclosing.any()),
        findings=tuple(findings),
    )


def refuse_errors(twin: Twin) -> None:
    """Raise what stops a build, all of it at once.

    Raises
    ------
    SceneError
        When the twin has findings that are errors.
    """
    errors = [finding.message for finding in twin.findings if finding.severity == "error"]
    if errors:
        raise SceneError("; ".join(errors))


def _scene_findings(
    site: SiteFile, scene: Scene, parts: tuple[Part, ...], enclosing: NDArray[np.bool_]
) -> list[Finding]:
    messages = []
    extent = scene.bounds[1] - scene.bounds[0]
    size = " x ".join(f"{length:,.6g}" for length in extent)
    if extent.max() > LARGE_SCENE:
        messages.append(f'the scene is {size} m large; if its coordinates are millimetres, set scene_unit = "mm"')
    elif extent.max() < SMALL_SCENE:
        messages.append(f"the scene is only {size} m large; set scene_unit to the unit of its coordinates")
    if extent[2] > 2.0 * extent[:2].min() and site.site.scene_up == "z":
        messages.append(f'the scene is {size} m large and seems to lie on its side; if y points up, set scene_up = "y"')
    if scene.num_degenerate:
        messages.append(f"{scene.num_degenerate} triangles have no area and are left out; clean the mesh")
    open_names = _names([part for part in parts if not part.closed])
    if open_names:
        messages.append(
            f"open parts without an inside: {open_names}; they reflect, but count as sheets and not as solids: close "
            "them if they are solid"
        )
    mixed = _names([part for part in parts if part.closed and not part.consistent])
    if mixed:
        messages.append(f"parts whose triangles face different ways: {mixed}; harmless here, but mend the mesh")
    inverted = _names(
        [
            part
            for part, encloses in zip(parts, enclosing, strict=True)
            if part.closed and part.consistent and part.volume < 0 and not encloses
        ]
    )
    if inverted:
        messages.append(f"solids whose triangles face inwards: {inverted}; harmless here, but mend the mesh")
    return [Finding(severity="warning", message=message) for message in messages]


def _material_findings(site: SiteFile, scene: Scene) -> list[Finding]:
    """Where the constant loss stands in for a material."""
    if site.propagation.reflection != "itu":
        return []
    messages = []
    bare = np.count_nonzero(scene.face_materials < 0)
    if bare:
        messages.append(
            f"{bare} of {len(scene.faces)} triangles have no material: reflection_loss_db is taken; give them one of "
            "ITU-R P.2040, e.g. itu_concrete"
        )
    carrier = site.propagation.carrier_ghz
    for n, name in enumerate(scene.materials):
        if complex_permittivity(name, carrier) is not None or not np.any(scene.face_materials == n):
            continue
        known = itu_name(name)
        if known is None:
            messages.append(
                f"material '{name}' unknown: reflection_loss_db is taken; ITU-R P.2040 has {', '.join(ITU_MATERIALS)}"
            )
        else:
            ranges = " and ".join(f"{row.lowest_ghz:g} to {row.highest_ghz:g} GHz" for row in ITU_MATERIALS[known])
            messages.append(
                f"material '{name}' is known for {ranges} only, not at carrier_ghz = {carrier:g}: reflection_loss_db "
                "is taken; choose another material"
            )
    return [Finding(severity="warning", message=message) for message in messages]


def _station_findings(
    site: SiteFile,
    scene: Scene,
    parts: tuple[Part, ...],
    enclosing: NDArray[np.bool_],
    inside: NDArray[np.bool_],
) -> list[Finding]:
    messages = []
    low, high = scene.bounds
    for s, station in enumerate(site.stations):
        position = np.array(station.position_m)
        place = f"station '{station.id}' at ({', '.join(f'{v:g}' for v in station.position_m)}) m"
        if np.any(position < low) or np.any(position > high):
            box = " to ".join(f"({', '.join(f'{v:g}' for v in corner)})" for corner in (low, high))
            messages.append(f"{place} lies outside the scene, which spans {box} m; correct position_m or scene_unit")
            continue
        face = touched(scene.triangles, position)
        if face >= 0:
            name = scene.objects[scene.face_objects[face]]
            messages.append(f"{place} lies on the surface of '{name}'; move it a few centimetres off")
            continue
        for p, part in enumerate(parts):
            if part.closed and inside[p, s] != enclosing[p]:
                where = (
                    f"inside the solid '{part.name}'" if inside[p, s] else f"outside or in the wall of '{part.name}'"
                )
                messages.append(f"{place} lies {where}; move it into free space")
                break
    return [Finding(severity="error", message=message) for message in messages]


def _names(parts: list[Part], most: int = 5) -> str:
    names = list(dict.fromkeys(part.name for part in parts))
    more = f" and {len(parts) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
