"""Read table files. The arrays are mapped, not read: workers that serve one table share its pages."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.compact.tubes import COMPACT_FIELDS, CompactTubes
from rayfix_tables.disk.calibrated import read_calibration
from rayfix_tables.disk.files import open_table_file
from rayfix_tables.disk.layout import FileLayout, damage_reported, read_layout
from rayfix_tables.disk.schema import (
    COMPACT_LEVEL_DATASETS,
    COMPACT_PATH_DATASETS,
    FORMAT_VERSION,
    LEVEL_DATASETS,
    PATH_DATASETS,
    SCENE_DATASETS,
    array_digest,
    content_id,
    content_of,
    level_path,
    paths_path,
    read_bias,
    read_mounting,
)
from rayfix_tables.disk.selected import read_selection
from rayfix_tables.disk.values import check_finite, check_offsets, check_range, check_rings
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import COMPACT_UNBALANCED, UNBALANCED, Level
from rayfix_tables.mixture import FIELD_SHAPES, TubeMixture
from rayfix_tables.part import StationPart, Update
from rayfix_tables.paths import COMPACT_SEQUENCE, COMPACT_WEIGHT, GAIN_FIELDS, PathMap
from rayfix_tables.scene import Scene
from rayfix_tables.site import SiteInfo, Station

_WIDEST_WINDOW = 2.0 * math.pi
"""Of compact components, rad: their angles are numbers of windows, and must not overflow."""

_LARGEST_UNIT = 2.0**15
"""Of weights: times the largest number of half precision, it is far from the largest of single precision."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """An open table. Use :meth:`open`.

    Attributes
    ----------
    parts : dict of str to StationPart
        By station identifier, in the site's order.
    layout : FileLayout
        Layout of the file. The ``table_id`` is computed from it and the arrays.
    mapped : ndarray of uint8
        Bytes of the file.
    """

    path: Path
    table_id: str
    format_version: int
    software_version: str
    site: SiteInfo
    scene: Scene
    parts: dict[str, StationPart]
    layout: FileLayout = field(default_factory=FileLayout, repr=False, compare=False)
    mapped: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8), repr=False, compare=False)

    def __repr__(self) -> str:
        """Describe the table without its arrays."""
        return f"Table({str(self.path)!r}, site {self.site.name!r}, {len(self.parts)} stations, {self.table_id[:12]})"

    @classmethod
    def open(cls, path: str | Path) -> "Table":
        """Map a table file.

        Checks the format, completeness, and that numbers are finite and indices within range; :meth:`verify` also
        compares the checksums. HDF5 reads the file in this process, and a damaged file can make it crash or hang: for
        an untrusted file use :func:`rayfix_tables.checked.open_checked`, which checks it in a separate process.

        Raises
        ------
        TableError
            When the file is missing.
        NotATableError
            When it is not a rayfix table.
        FormatVersionError
            When another version of rayfix wrote it.
        CorruptTableError
            When it is truncated, or a part of it is missing.
        """
        path = Path(path)
        with open_table_file(path) as opened, damage_reported(path):
            table = cls.of_layout(path, read_layout(opened), opened.mapped())
            check_finite(table.arrays())
            return table

    @classmethod
    def of_layout(cls, path: Path, layout: FileLayout, mapped: NDArray[np.uint8]) -> "Table":
        """Make the table of a mapped file from its layout, without HDF5. Call it within ``damage_reported``.

        Raises
        ------
        KeyError, ValueError
            When a part is missing or inconsistent with others.
        """
        root = layout.attributes[""]
        version = int(_finite(root["format_version"]))
        site_document = _read_json(layout, mapped, "site")
        if not isinstance(site_document, dict):
            raise ValueError("site is not a JSON object")
        scene = _read_scene(layout, mapped)
        station_ids = site_document["station_ids"]
        _check_members(layout, station_ids)
        stations: list[Station] = []
        parts: dict[str, StationPart] = {}
        for station_id in station_ids:
            attributes = layout.attributes[f"stations/{station_id}"]
            angles, deviations = read_calibration(attributes)
            station = Station(
                id=station_id,
                position=_triple(attributes["position_m"]),
                orientation=_radians(_triple(attributes["orientation_deg"])),
                field_of_view=float(np.deg2rad(_finite(attributes["field_of_view_deg"]))),
                bias=replace(read_bias(attributes), angles=angles),
                mounting=read_mounting(attributes),
                deviations=deviations,
                selection=read_selection(attributes),
            ).moved(scene.origin)
            read = _read_compact_level if version >= FORMAT_VERSION else _read_level
            levels = tuple(read(path, layout, mapped) for path in _level_paths(layout, station_id))
            stations.append(station)
            parts[station_id] = StationPart(
                station=station,
                levels=levels,
                lost_ray_share=_finite(attributes["lost_ray_share"]),
                coverage=_row(attributes["coverage"]),
                wall_coverage=_row(attributes.get("wall_coverage", ())),
                cut_power_share=_finite(attributes.get("cut_power_share", 0.0)),
                part_id=_text(attributes["part_id"]),
                update=_read_update(station_id, layout, levels, mapped),
                paths=_read_paths(station_id, layout, mapped, scene.free_space, compact=version >= FORMAT_VERSION),
            )
        return cls(
            path=path,
            table_id=_text(root["table_id"]),
            format_version=version,
            software_version=_text(root["software_version"]),
            site=SiteInfo(
                name=_text(site_document["name"]),
                north=float(np.deg2rad(_finite(site_document["north_deg"]))),
                max_path_length=_finite(site_document["max_path_length_m"]),
                stations=tuple(stations),
                document=_object(site_document["document"]),
            ),
            scene=scene,
            parts=parts,
            layout=layout,
            mapped=mapped,
        )

    @property
    def passes_walls(self) -> bool:
        """Whether paths pass walls; otherwise all walls were taken for opaque."""
        return any(part.wall_coverage for part in self.parts.values())

    @cached_property
    def in_table_frame(self) -> "Table":
        """The table with scene and stations in the frame of its components; its fixes are in that frame too."""
        if not self.scene.origin.any():
            return self
        stations = tuple(station.moved(-self.scene.origin) for station in self.site.stations)
        return replace(
            self,
            site=replace(self.site, stations=stations),
            scene=self.scene.in_table_frame,
            parts={station.id: replace(self.parts[station.id], station=station) for station in stations},
        )

    def levels(self, station_id: str) -> tuple[Level, ...]:
        """Levels of a station, finest first."""
        return self.parts[station_id].levels

    def arrays(self) -> Iterator[tuple[str, NDArray[Any]]]:
        """Arrays of the table as stored in the file, by path of the dataset."""
        for path in self.layout.datasets:
            yield path, self.layout.array(path, self.mapped)

    def verify(self) -> None:
        """Read every byte of the file that was opened, and compare the checksums.

        Raises
        ------
        CorruptTableError
            When a dataset or the ``table_id`` does not match.
        """
        with damage_reported(self.path):
            digests: dict[str, str] = {}
            for name, array in self.arrays():
                digests[name] = array_digest(array)
                if digests[name] != self.layout.attributes[name].get("sha256"):
                    raise ValueError(f"the checksum of {name} does not match")
            if content_id(content_of(self.layout.attributes), digests) != self.table_id:
                raise ValueError("the table_id does not match the content")
            check_finite(self.arrays())


def _check_members(layout: FileLayout, station_ids: Any) -> None:
    """Check that the file has exactly the stations of the site, and no other group or dataset."""
    named = isinstance(station_ids, list) and all(isinstance(each, str) for each in station_ids)
    if not named or not station_ids or len(set(station_ids)) < len(station_ids):
        raise ValueError("station_ids are not a list of different stations")
    known = {f"stations/{station_id}" for station_id in station_ids}
    for path in layout.attributes:
        station = "/".join(path.split("/")[:2])
        if path.startswith("stations/") and station not in known:
            raise ValueError(f"{station} is not a station of the site")


def _level_paths(layout: FileLayout, station_id: str) -> list[str]:
    """Paths of a station's levels, finest first."""
    group = f"stations/{station_id}/levels/"
    count = sum(path.startswith(group) and "/" not in path.removeprefix(group) for path in layout.attributes)
    if not count:
        raise ValueError(f"stations/{station_id} has no level")
    return [level_path(station_id, n) for n in range(count)]


def _read_level(path: str, layout: FileLayout, mapped: NDArray[np.uint8]) -> Level:
    """Read a level of a version without compact components."""
    _check_absent(layout, path, (*(COMPACT_LEVEL_DATASETS.keys() - LEVEL_DATASETS.keys()), "log_balance16"))
    arrays, grid = _level_arrays(path, layout, mapped, LEVEL_DATASETS, FIELD_SHAPES)
    mixture = TubeMixture(**{name: arrays[name] for name in FIELD_SHAPES})
    return _level(path, layout, mapped, arrays, grid, mixture)


def _read_compact_level(path: str, layout: FileLayout, mapped: NDArray[np.uint8]) -> Level:
    """Read a level of compact components."""
    _check_absent(layout, path, (*(LEVEL_DATASETS.keys() - COMPACT_LEVEL_DATASETS.keys()), "log_balance"))
    shapes = {name: shape for name, (_, shape) in COMPACT_FIELDS.items()}
    arrays, grid = _level_arrays(path, layout, mapped, COMPACT_LEVEL_DATASETS, shapes)
    window = _window(path, layout, compact=True)
    mixture = CompactTubes(window=window, **{name: arrays[name] for name in COMPACT_FIELDS})
    return _level(path, layout, mapped, arrays, grid, mixture)


def _check_absent(layout: FileLayout, group: str, names: Iterable[str]) -> None:
    """Check that a group has no dataset of another version of the format."""
    for name in names:
        if f"{group}/{name}" in layout.datasets:
            raise ValueError(f"{group}/{name} does not belong to a table of this format version")


def _window(path: str, layout: FileLayout, *, compact: bool) -> float:
    if compact:
        window = _positive(layout.attributes[path]["window_rad"], f"window_rad of {path}")
        if window > _WIDEST_WINDOW:
            raise ValueError(f"window_rad of {path} is {window}")
        return window
    return float(np.deg2rad(_positive(layout.attributes[path]["window_deg"], f"window_deg of {path}")))


def _level_arrays(
    path: str,
    layout: FileLayout,
    mapped: NDArray[np.uint8],
    datasets: Iterable[str],
    component_shapes: Mapping[str, tuple[int, ...]],
) -> tuple[dict[str, NDArray[Any]], AngularGrid]:
    """Read the datasets of a level, with the shapes that they should have, and its grid."""
    arrays = {name: layout.array(f"{path}/{name}", mapped) for name in datasets}
    offsets = arrays["cell_offsets"]
    check_rings(f"{path}/ring_cells", arrays["ring_cells"], len(offsets) - 1)
    grid = AngularGrid(ring_cells=np.array(arrays["ring_cells"]))
    length = len(arrays["x_mean"])
    has_walls = f"{path}/num_walls" in layout.datasets
    arrays["num_walls"] = (
        layout.array(f"{path}/num_walls", mapped) if has_walls else np.broadcast_to(np.int8(0), length)
    )
    shapes = {name: (length, *shape) for name, shape in component_shapes.items()}
    shapes |= {"cell_offsets": (grid.num_cells + 1,), "cell_log_mass": (grid.num_cells,)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{path}/{name} has the shape {arrays[name].shape}, not {shape}")
    check_offsets(f"{path}/cell_offsets", offsets, length)
    return arrays, grid


def _level(
    path: str,
    layout: FileLayout,
    mapped: NDArray[np.uint8],
    arrays: Mapping[str, NDArray[Any]],
    grid: AngularGrid,
    mixture: TubeMixture | CompactTubes,
) -> Level:
    compact = isinstance(mixture, CompactTubes)
    name = f"{path}/log_balance16" if compact else f"{path}/log_balance"
    unbalanced = COMPACT_UNBALANCED if compact else UNBALANCED
    log_balance = layout.array(name, mapped) if name in layout.datasets else unbalanced
    if len(log_balance) not in (0, len(mixture)):
        raise ValueError(f"{name} has {len(log_balance)} entries, not {len(mixture)}")
    return Level(
        window=_window(path, layout, compact=compact),
        grid=grid,
        cell_offsets=arrays["cell_offsets"],
        cell_log_mass=arrays["cell_log_mass"],
        mixture=mixture,
        log_balance=log_balance,
    )


def _read_update(
    station_id: str, layout: FileLayout, levels: tuple[Level, ...], mapped: NDArray[np.uint8]
) -> Update | None:
    attributes = layout.attributes[f"stations/{station_id}"]
    paths = [f"{level_path(station_id, n)}/cell_change" for n in range(len(levels))]
    if "exact_part_id" not in attributes:
        if any(path in layout.datasets for path in paths):
            raise ValueError(f"stations/{station_id} has cell_change and no exact_part_id")
        return None
    changes = tuple(layout.array(path, mapped) for path in paths)
    for path, change, level in zip(paths, changes, levels, strict=True):
        if len(change) != level.num_cells:
            raise ValueError(f"{path} has {len(change)} entries, not {level.num_cells}")
    return Update(
        exact_part_id=_text(attributes["exact_part_id"]),
        former_part_id=_text(attributes["former_part_id"]),
        tolerance=_finite(attributes["update_tolerance"]),
        cell_change=changes,
    )


def _read_paths(
    station_id: str, layout: FileLayout, mapped: NDArray[np.uint8], free_space: FreeSpace, *, compact: bool
) -> PathMap | None:
    group = paths_path(station_id)
    if group not in layout.attributes:
        return None
    attributes = layout.attributes[group]
    names = {name: name for name in PATH_DATASETS}
    if compact:
        names["weight"] = COMPACT_WEIGHT
        if f"{group}/{COMPACT_SEQUENCE}" in layout.datasets:
            names["sequence"] = COMPACT_SEQUENCE
    _check_absent(layout, group, (PATH_DATASETS.keys() | COMPACT_PATH_DATASETS.keys()) - set(names.values()))
    arrays = {
        name: np.zeros(0, dtype)
        if name in GAIN_FIELDS and f"{group}/{name}" not in layout.datasets
        else layout.array(f"{group}/{names[name]}", mapped)
        for name, (dtype, _) in PATH_DATASETS.items()
    }
    weight_unit = _positive(attributes["weight_unit"], f"weight_unit of {group}") if compact else 1.0
    if weight_unit > _LARGEST_UNIT:
        raise ValueError(f"weight_unit of {group} is {weight_unit}")
    voxel_size = _positive(attributes["voxel_size_m"], f"voxel_size_m of {group}")
    refinement = max(1, round(voxel_size / free_space.voxel_size))
    shape = tuple((-(-np.array(free_space.free.shape) // refinement)).tolist())
    if _row(attributes["shape"]) != shape:
        raise ValueError(f"{group} is not a map of the free space")
    count, num_sequences = len(arrays["sequence"]), len(arrays["images"])
    shapes: dict[str, tuple[int, ...]] = {
        "offsets": (math.prod(shape) + 1,),
        "weight": (count,),
        "excess": (len(arrays["excess"]) and count,),
        "num_walls": (len(arrays["excess"]) and count,),
        "images": (num_sequences, 3),
        "mirrors": (num_sequences, 3, 3),
        "num_reflections": (num_sequences,),
        "log_gain": (len(arrays["lit"]) and count,),
        "lit": (len(arrays["lit"]) and count,),
    }
    for name, expected in shapes.items():
        if arrays[name].shape != expected:
            raise ValueError(f"{group}/{names[name]} has the shape {arrays[name].shape}, not {expected}")
    check_offsets(f"{group}/offsets", arrays["offsets"], count)
    check_range(f"{group}/{names['sequence']}", arrays["sequence"], 0, num_sequences - 1)
    return PathMap(
        origin=np.array(_triple(attributes["origin_m"])),
        voxel_size=voxel_size,
        shape=shape,
        weight_unit=weight_unit,
        **arrays,
    )


def _read_scene(layout: FileLayout, mapped: NDArray[np.uint8]) -> Scene:
    arrays = {name: layout.array(name, mapped) for name in SCENE_DATASETS}
    vertices, faces = arrays["scene/vertices_m"], arrays["scene/faces"]
    face_materials, free = arrays["scene/face_materials"], arrays["scene/free_space"]
    materials = _read_json(layout, mapped, "scene/materials")
    if not isinstance(materials, list):
        raise ValueError("materials are not a list")
    for name, array in (("scene/vertices_m", vertices), ("scene/faces", faces)):
        if array.shape[1] != 3:
            raise ValueError(f"{name} has the shape {array.shape}, not (n, 3)")
    if len(face_materials) != len(faces):
        raise ValueError(f"scene/face_materials has {len(face_materials)} entries, not {len(faces)}")
    check_range("scene/faces", faces, 0, len(vertices) - 1)
    check_range("scene/face_materials", face_materials, -1, len(materials) - 1)
    check_range("scene/free_space", free, 0, 1)
    thickness = None
    if "scene/face_thickness_m" in layout.datasets:
        stored = layout.array("scene/face_thickness_m", mapped)
        if len(stored) != len(faces) or np.any(stored < 0.0):
            raise ValueError("scene/face_thickness_m does not have one thickness for each face")
        thickness = np.where(stored > 0.0, stored, np.nan)
    free_space = layout.attributes["scene/free_space"]
    origin = np.array(_triple(layout.attributes["scene"].get("origin_m", (0.0, 0.0, 0.0))))
    in_table_frame = Scene(
        vertices=vertices,
        faces=faces,
        face_materials=face_materials,
        materials=tuple(_text(name) for name in materials),
        free_space=FreeSpace(
            origin=np.array(_triple(free_space["origin_m"])),
            voxel_size=_positive(free_space["voxel_size_m"], "voxel_size_m"),
            free=free.view(np.bool_),
        ),
        sha256=_text(layout.attributes[""]["scene_sha256"]),
        face_thickness=thickness,
    )
    return in_table_frame.moved(origin)


def _read_json(layout: FileLayout, mapped: NDArray[np.uint8], path: str) -> Any:
    """Read a dataset of text, which in version 1 was an attribute of the group."""
    if path in layout.datasets:
        try:
            return json.loads(layout.array(path, mapped).tobytes())
        except ValueError as error:
            raise ValueError(f"{path} is not JSON: {error}") from error
    group, _, name = path.rpartition("/")
    return json.loads(_text(layout.attributes[group][name]))


def _text(value: Any) -> str:
    """Check that a value is text, which can be written into answers."""
    if not isinstance(value, str):
        raise ValueError(f"{type(value).__name__} where there should be text")
    value.encode("utf-8")
    return value


def _finite(value: Any) -> float:
    if not isinstance(value, int | float) or not np.isfinite(float(value)):
        raise ValueError(f"{str(value)[:40]} where there should be a finite number")
    return float(value)


def _positive(value: Any, name: str) -> float:
    if not (number := _finite(value)) > 0.0:
        raise ValueError(f"{name} is {number}")
    return number


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = _row(values)
    return (x, y, z)


def _row(values: Any) -> tuple[float, ...]:
    if not isinstance(values, list | tuple):
        raise ValueError(f"{str(values)[:40]} where there should be a row of numbers")
    return tuple(_finite(value) for value in values)


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{type(value).__name__} where there should be a JSON object")
    return value


def _radians(degrees: tuple[float, float, float]) -> tuple[float, float, float]:
    a, b, c = np.deg2rad(degrees).tolist()
    return (a, b, c)
