"""Findings: problems of a scene or a site, each with its remedy."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rayfix_offline.scene.materials import ITU_MATERIALS, complex_permittivity, itu_name
from rayfix_offline.scene.scene import METRES_PER_UNIT, Scene
from rayfix_offline.scene.walls import section_of
from rayfix_offline.site import SiteFile, StationSection
from rayfix_offline.twin.cleaning import Duplicates
from rayfix_offline.twin.enclosures import Enclosures
from rayfix_offline.twin.partitions import THICKNESS, Partitions
from rayfix_offline.twin.solids import Part, touched

LARGE_SCENE, SMALL_SCENE = 1000.0, 1.0
"""A scene larger or smaller than this probably has another unit, m."""

HIGH_ROOM = 60.0
"""So has an empty room that is higher, m."""

OPAQUE_ABOVE = 10.0
"""Carrier frequency above which thin partitions attenuate signals strongly, GHz."""

MOST_NAMES = 4


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A problem of a site or its scene.

    Attributes
    ----------
    severity : {"error", "warning"}
        An error stops the build.
    kind : str
        Topic in one or two words, the same for all findings of a kind.
    problem : str
        The problem and where it is.
    remedy : str
        How to solve it.
    station_id : str, optional
        Station that it concerns.
    """

    severity: Literal["error", "warning"]
    kind: str
    problem: str
    remedy: str
    station_id: str | None = None

    @property
    def message(self) -> str:
        """Problem and remedy."""
        return f"{self.problem}; {self.remedy}"


def warning(kind: str, problem: str, remedy: str) -> Finding:
    """Return a finding that does not stop the build."""
    return Finding(severity="warning", kind=kind, problem=problem, remedy=remedy)


def error(kind: str, problem: str, remedy: str, *, station_id: str | None = None) -> Finding:
    """Return a finding that stops the build."""
    return Finding(severity="error", kind=kind, problem=problem, remedy=remedy, station_id=station_id)


def size_findings(site: SiteFile, scene: Scene) -> Iterator[Finding]:
    """Check the scene's unit and upward axis."""
    extent = scene.bounds[1] - scene.bounds[0]
    size = " x ".join(f"{length:,.6g}" for length in extent)
    if site.room is not None:
        if extent.max() > LARGE_SCENE or extent[2] > HIGH_ROOM:
            yield warning("unit", f"the room is {size} m large", "size_m is in metres")
    elif extent.max() > LARGE_SCENE:
        remedy = 'if its coordinates are millimetres, set scene_unit = "mm"'
        yield warning("unit", f"the scene is {size} m large", remedy)
    elif extent.max() < SMALL_SCENE:
        yield warning("unit", f"the scene is only {size} m large", "set scene_unit to the unit of its coordinates")
    if extent[2] > 2.0 * extent[:2].min() and not scene.says_up:
        other = _other_axis(site)
        yield warning(
            "upward axis",
            f"the scene is {size} m large and seems to lie on its side",
            f'if {other} points up, set scene_up = "{other}"',
        )


def reach_findings(site: SiteFile, scene: Scene) -> Iterator[Finding]:
    """Find stations of an empty room whose rays end before they have crossed it."""
    if site.room is None:
        return
    longest = site.propagation.max_path_length_m
    far = []
    for station in site.stations:
        position = np.asarray(station.position_m)
        across = float(np.linalg.norm(np.maximum(position - scene.bounds[0], scene.bounds[1] - position)))
        if across > longest:
            far.append((across, station.id))
    if far:
        names = _listed([f"'{name}'" for _, name in far])
        yield warning(
            "short paths",
            f"rays end after max_path_length_m = {longest:g} m, before they reach all of the room from {names}",
            f"give {max(far)[0]:.1f} at least, and more for reflected paths",
        )


def file_findings(scene: Scene) -> Iterator[Finding]:
    """Report what the scene file's reader left out or changed."""
    for remark in scene.remarks:
        yield warning(remark.kind, remark.problem, remark.remedy)


def mesh_findings(
    scene: Scene, duplicates: Duplicates, parts: Sequence[Part], enclosures: Enclosures
) -> Iterator[Finding]:
    """Find defects of the mesh."""
    if scene.num_degenerate:
        problem = f"{scene.num_degenerate} triangles have no area and are removed"
        yield warning("degenerate", problem, "clean the mesh")
    if duplicates.num_copies:
        problem = f"{duplicates.num_copies} duplicate triangles are removed"
        yield warning("duplicate", problem, "remove duplicate faces from the mesh")
    if duplicates.num_backs:
        problem = f"{duplicates.num_backs} triangles are back faces of others and are removed"
        yield warning("duplicate", problem, "export single-sided faces: both sides reflect")
    if duplicates.coinciding:
        pairs = [f"{a} and {b}" for a, b in duplicates.coinciding]
        yield warning("duplicate", f"objects that coincide, wholly or in part: {_listed(pairs)}", "keep one of them")
    sheets = [part for part in parts if not part.closed]
    if sheets:
        yield warning(
            "open",
            f"open parts without an inside: {_names(sheets)}; they reflect, but count as sheets and not as solids",
            "close them if they are solid",
        )
    crowded = [part for part in parts if not part.manifold]
    if crowded:
        yield warning(
            "non-manifold",
            f"parts with edges that more than two triangles share: {_names(crowded)}",
            "harmless where solids touch; else remove what is inside the mesh",
        )
    mixed = [part for part in parts if part.closed and part.manifold and not part.consistent]
    if mixed:
        problem = f"parts whose triangles face different ways: {_names(mixed)}"
        yield warning("facing", problem, "harmless here, but mend the mesh")
    inverted = [
        part
        for part, encloses in zip(parts, enclosures.enclosing, strict=True)
        if part.closed and part.consistent and part.volume < 0 and not encloses
    ]
    if inverted:
        problem = f"solids whose triangles face inwards: {_names(inverted)}"
        yield warning("facing", problem, "harmless here, but mend the mesh")


def material_findings(site: SiteFile, scene: Scene) -> Iterator[Finding]:
    """Find where the constant loss replaces that of a material."""
    if site.propagation.reflection != "itu":
        sides = () if site.room is None else (site.room.walls, site.room.floor, site.room.ceiling)
        named = [f"'{name}'" for name in dict.fromkeys(sides) if name is not None and section_of(site, name) is None]
        if named:
            yield warning(
                "material",
                f'with reflection = "constant" the materials of the room are not looked up: {_listed(named)}',
                'set reflection = "itu" in [propagation], or leave them out',
            )
        return
    bare = np.count_nonzero(scene.face_materials < 0)
    if bare:
        yield warning(
            "material",
            f"{bare} of {len(scene.faces)} triangles have no material: reflection_loss_db is taken",
            "give them one of ITU-R P.2040, e.g. itu_concrete",
        )
    carrier = site.propagation.carrier_ghz
    unknown = []
    for n, name in enumerate(scene.materials):
        if complex_permittivity(name, carrier) is not None or not np.any(scene.face_materials == n):
            continue
        known = itu_name(name)
        if known is None:
            unknown.append(f"'{name}'")
            continue
        ranges = " and ".join(f"{row.lowest_ghz:g} to {row.highest_ghz:g} GHz" for row in ITU_MATERIALS[known])
        yield warning(
            "material",
            f"material '{name}' is known for {ranges} only, not at carrier_ghz = {carrier:g}: reflection_loss_db is "
            "taken",
            "choose another material",
        )
    if unknown:
        yield warning(
            "material",
            f"material{'s' if len(unknown) > 1 else ''} {_listed(unknown)} unknown: reflection_loss_db is taken",
            f"ITU-R P.2040 has {', '.join(ITU_MATERIALS)}",
        )


def wall_findings(site: SiteFile, scene: Scene) -> Iterator[Finding]:
    """Find what is known of walls but not used."""
    of_scene = {section_of(site, name) for name in scene.materials}
    unused = [f"'{name}'" for name in site.materials if name not in of_scene]
    if unused:
        names = ", ".join(f"'{name}'" for name in scene.materials) or "no materials"
        yield warning(
            "material",
            f"the site file describes {_listed(unused)}, which the scene does not have",
            f"give the sections the names of the scene's materials: {names}",
        )
    carrier = site.propagation.carrier_ghz
    for key, section in site.materials.items():
        if section.itu is not None and itu_name(section.itu) is None:
            yield error(
                "material",
                f"materials.{key}.itu = '{section.itu}' is not in ITU-R P.2040",
                f"it has {', '.join(ITU_MATERIALS)}",
            )
            continue
        needs = section.thickness_m is not None and section.permittivity is None
        if not needs or section.transmission_loss_db is not None:
            continue
        if itu_name(section.itu or key) is None:
            yield error(
                "material",
                f"materials.{key} has a thickness but no permittivity",
                "add itu, permittivity or transmission_loss_db",
            )
        elif complex_permittivity(section.itu or key, carrier) is None:
            yield warning(
                "material",
                f"the permittivity of '{key}' is not known at carrier_ghz = {carrier:g}, and its walls let nothing "
                "through",
                "give permittivity and conductivity_s_m, or transmission_loss_db",
            )
    if scene.face_thickness is None or site.propagation.reflection == "itu" or not site.propagation.transmission:
        return
    stated = np.unique(scene.face_materials[np.isfinite(scene.face_thickness)])
    silent = [f"'{scene.materials[n]}'" for n in stated if n >= 0 and section_of(site, scene.materials[n]) is None]
    if silent:
        yield warning(
            "material",
            f'the scene states the thickness of {_listed(silent)}, but with reflection = "constant" materials are not '
            "looked up, and nothing passes these walls",
            'set reflection = "itu", or describe the materials in the site file',
        )


def partition_findings(
    site: SiteFile, scene: Scene, partitions: Partitions, passable: NDArray[np.bool_]
) -> Iterator[Finding]:
    """Warn of thin walls that block all rays, but not signals of low frequencies."""
    faces = partitions.faces & ~passable
    if site.propagation.carrier_ghz >= OPAQUE_ABOVE or not faces.any():
        return
    walls = [scene.objects[n] for n in np.unique(scene.face_objects[faces])]
    yield warning(
        "thin partition",
        f"walls thinner than {THICKNESS:g} m, not known to be of concrete, brick or metal, divide the free space into "
        f"{partitions.rooms} rooms: {_listed(walls)}; at {site.propagation.carrier_ghz:g} GHz signals pass thin "
        "partitions, but rays pass no wall of unknown material or thickness",
        "give their materials a thickness_m in [materials.NAME] of the site file"
        + ("" if site.propagation.transmission else " and set transmission = true")
        + ", or leave thin partitions and doors out of the mesh; name the material of walls of concrete, brick or "
        "metal",
    )


def station_findings(
    site: SiteFile,
    scene: Scene,
    parts: Sequence[Part],
    enclosures: Enclosures,
    *,
    touch: float,
    origin: NDArray[np.float64],
) -> Iterator[Finding]:
    """Find stations at impossible positions; one nearer than ``touch`` [m] to a surface lies on it.

    Site and scene are relative to an origin of shape (3,), m, which the findings add to positions.
    """
    given = site.moved(origin)
    outside = _what_would_hold_stations(given, scene, origin) or "correct position_m or scene_unit"
    for s, station in enumerate(given.stations):
        position = np.array(site.stations[s].position_m)
        located = _located(station)
        problem = _misplacement(position, scene, parts, enclosures, s, touch, origin)
        if problem is not None:
            where, remedy = problem
            yield error("station", f"{located} lies {where}", remedy or outside, station_id=station.id)


def _misplacement(
    position: NDArray[np.float64],
    scene: Scene,
    parts: Sequence[Part],
    enclosures: Enclosures,
    station: int,
    touch: float,
    origin: NDArray[np.float64],
) -> tuple[str, str] | None:
    """Where a misplaced station lies, and the remedy, which is empty far from the scene; None for a valid position."""
    low, high = scene.bounds
    if np.any(position < low) or np.any(position > high):
        box = " to ".join(
            f"({', '.join(f'{v:.10g}' for v in np.round(corner, 6))})" for corner in (low + origin, high + origin)
        )
        return f"outside the scene, which spans {box} m", ""
    face = touched(scene.triangles, position, touch=touch)
    if face >= 0:
        return f"on the surface of '{scene.objects[scene.face_objects[face]]}'", "move it a few centimetres off"
    held = [int(p) for p in np.flatnonzero(enclosures.inside[:, station]) if not enclosures.enclosing[p]]
    if held:
        return f"inside the solid '{parts[held[0]].name}'", "move it into free space"
    if enclosures.rooms.any() and not enclosures.inside[enclosures.rooms, station].any():
        rooms = [f"'{part.name}'" for part, is_room in zip(parts, enclosures.rooms, strict=True) if is_room]
        return f"outside or in the wall of {_listed(rooms)}", "move it into free space"
    return None


def _what_would_hold_stations(site: SiteFile, scene: Scene, origin: NDArray[np.float64]) -> str | None:
    """Return the unit or the upward axis with which all stations would lie inside; None if they do, or with none."""
    positions = np.array([station.position_m for station in site.stations])
    given = scene.bounds + origin

    def held(bounds: NDArray[np.float64]) -> bool:
        return bool(np.all((positions >= bounds[0]) & (positions <= bounds[1])))

    remedy = None
    if not held(given):
        current = METRES_PER_UNIT[site.site.scene_unit]
        units = [unit for unit, metres in METRES_PER_UNIT.items() if held(given * metres / current)]
        if units:
            remedy = f'scene_unit = "{units[0]}"'
        elif not scene.says_up and held(_turned(given, site.site.scene_up)):
            remedy = f'scene_up = "{_other_axis(site)}"'
    return remedy and f"set {remedy}: then all stations lie inside"


def _other_axis(site: SiteFile) -> str:
    return "z" if site.site.scene_up == "y" else "y"


def _turned(bounds: NDArray[np.float64], up: str) -> NDArray[np.float64]:
    """Bounds of a scene that was read with this axis up, if the other one were up."""
    x, y, z = bounds.T
    turned = (x, z, -y) if up == "y" else (x, -z, y)
    return np.sort(np.stack(turned, axis=1), axis=0)


def _located(station: StationSection) -> str:
    return f"station '{station.id}' at ({', '.join(f'{v:.10g}' for v in station.position_m)}) m"


def _names(parts: Sequence[Part]) -> str:
    """Name parts, numbered ones with their position: a number alone would not help to find them."""
    return _listed(
        [
            f"{part.name} at ({', '.join(f'{v:.1f}' for v in part.middle)})" if "#" in part.name else part.name
            for part in parts
        ]
    )


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more
