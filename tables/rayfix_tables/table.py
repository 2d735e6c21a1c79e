"""Read table files. The arrays are mapped, not read: workers that serve one table share its pages."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.errors import CorruptTableError, FormatVersionError, NotATableError, TableError
from rayfix_tables.freespace import FreeSpace
from rayfix_tables.grid import AngularGrid
from rayfix_tables.level import UNBALANCED, Level
from rayfix_tables.mixture import FIELD_SHAPES, TubeMixture
from rayfix_tables.schema import (
    CELL_CHANGE,
    FORMAT,
    FORMAT_VERSION,
    LEVEL_DATASETS,
    LOG_BALANCE,
    SCENE_DATASETS,
    array_digest,
    content_attributes,
    content_id,
    dataset_paths,
    level_path,
    read_bias,
)
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.update import Update


@dataclass(frozen=True, kw_only=True)
class StationPart:
    """A station's part of the table; see :class:`rayfix_tables.write.StationContent`."""

    station: Station
    levels: tuple[Level, ...]
    lost_ray_share: float
    coverage: tuple[float, ...]
    part_id: str = ""
    update: Update | None = None


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The mesh that the table was built from, and its free space."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    face_materials: NDArray[np.int16]
    materials: tuple[str, ...]
    free_space: FreeSpace
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Table:
    """An open table. Use :meth:`open`.

    Attributes
    ----------
    parts : dict of str to StationPart
        By station identifier, in the site's order.
    """

    path: Path
    table_id: str
    format_version: int
    software_version: str
    site: SiteInfo
    scene: Scene
    parts: dict[str, StationPart]

    def __repr__(self) -> str:
        """Name the table; its arrays would fill the screen."""
        return f"Table({str(self.path)!r}, site {self.site.name!r}, {len(self.parts)} stations, {self.table_id[:12]})"

    @classmethod
    def open(cls, path: str | Path) -> "Table":
        """Map a table file.

        Checks the format and that the file is whole; :meth:`verify` also reads every byte.

        Raises
        ------
        TableError
            When the file is missing.
        NotATableError
            When it is not a rayfix table.
        FormatVersionError
            When another version of rayfix wrote it.
        CorruptTableError
            When it is truncated or a part is missing.
        """
        path = Path(path)
        with _damage_reported(path), _open_file(path) as file:
            return cls._read(path, file, np.memmap(path, dtype=np.uint8, mode="r"))

    @classmethod
    def _read(cls, path: Path, file: h5py.File, mapped: NDArray[np.uint8]) -> "Table":
        site_document = json.loads(file.attrs["site"])
        stations: list[Station] = []
        parts: dict[str, StationPart] = {}
        for station_id in site_document["station_ids"]:
            group = file[f"stations/{station_id}"]
            station = Station(
                id=station_id,
                position=_triple(group.attrs["position_m"]),
                orientation=_triple(np.deg2rad(group.attrs["orientation_deg"])),
                field_of_view=float(np.deg2rad(group.attrs["field_of_view_deg"])),
                bias=read_bias(group.attrs),
            )
            levels = tuple(_read_level(file[level_path(station_id, n)], mapped) for n in range(len(group["levels"])))
            stations.append(station)
            parts[station_id] = StationPart(
                station=station,
                levels=levels,
                lost_ray_share=float(group.attrs["lost_ray_share"]),
                coverage=tuple(float(share) for share in group.attrs["coverage"]),
                part_id=str(group.attrs["part_id"]),
                update=_read_update(group, levels, mapped),
            )
        return cls(
            path=path,
            table_id=str(file.attrs["table_id"]),
            format_version=int(file.attrs["format_version"]),
            software_version=str(file.attrs["software_version"]),
            site=SiteInfo(
                name=site_document["name"],
                north=float(np.deg2rad(site_document["north_deg"])),
                max_path_length=float(site_document["max_path_length_m"]),
                stations=tuple(stations),
                document=site_document["document"],
            ),
            scene=_read_scene(file, mapped),
            parts=parts,
        )

    def levels(self, station_id: str) -> tuple[Level, ...]:
        """Levels of a station, finest first."""
        return self.parts[station_id].levels

    def verify(self) -> None:
        """Read every byte and compare the checksums.

        Raises
        ------
        CorruptTableError
            When a dataset or the ``table_id`` does not match.
        """
        with _damage_reported(self.path), _open_file(self.path) as file:
            digests: dict[str, str] = {}
            for name in dataset_paths(file):
                digests[name] = array_digest(file[name][()])
                if digests[name] != str(file[name].attrs.get("sha256")):
                    raise ValueError(f"the checksum of {name} does not match")
            if content_id(content_attributes(file), digests) != str(file.attrs["table_id"]):
                raise ValueError("the table_id does not match the content")


@contextmanager
def _damage_reported(path: Path) -> Iterator[None]:
    """Say in one line what the readers make of a damaged file.

    A byte changed among the file's own administration shows as any of these: HDF5 raises OSError, KeyError or
    RuntimeError, and what it reads nevertheless may have any type.
    """
    try:
        yield
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        MemoryError,
        OSError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        raise CorruptTableError(
            f"{path} is damaged: {_one_line(error)}; restore it from a copy or build it again"
        ) from error


def _open_file(path: Path) -> h5py.File:
    try:
        missing = not path.exists()
    except PermissionError:  # of a folder on the way
        missing = False
    if missing:
        raise TableError(f"there is no table at {path}; build one with 'rayfix build SITE.toml -o {path}'")
    if not os.access(path, os.R_OK):
        raise TableError(f"{path} cannot be read; ask its owner for the right to read it")
    if path.is_dir() or not h5py.is_hdf5(path):
        raise NotATableError(f"{path} is not a rayfix table (not an HDF5 file); give a file that 'rayfix build' wrote")
    file = h5py.File(path, "r")
    if file.attrs.get("format") != FORMAT:
        file.close()
        raise NotATableError(f"{path} is an HDF5 file but not a rayfix table; give a file that 'rayfix build' wrote")
    version = file.attrs.get("format_version")
    if version != FORMAT_VERSION:
        file.close()
        raise FormatVersionError(
            f"{path} has table format {version}, this rayfix reads format {FORMAT_VERSION}; build the table again "
            "with this version, or install the version that wrote it"
        )
    return file


def _map(dataset: h5py.Dataset, kind: tuple[type[np.generic], int], mapped: NDArray[np.uint8]) -> NDArray[Any]:
    """View of a contiguous dataset in the mapped file."""
    dtype, ndim = np.dtype(kind[0]), kind[1]
    if dataset.dtype != dtype or dataset.ndim != ndim:
        raise ValueError(f"{dataset.name} is {dataset.dtype} with {dataset.ndim} axes, not {dtype} with {ndim}")
    if dataset.size == 0:
        return np.zeros(dataset.shape, dtype)
    offset = dataset.id.get_offset()
    if offset is None or offset + dataset.nbytes > mapped.size:
        raise ValueError(f"{dataset.name} is not whole")
    raw = mapped[offset : offset + dataset.nbytes]
    return raw.view(np.ndarray).view(dtype).reshape(dataset.shape)


def _read_level(group: h5py.Group, mapped: NDArray[np.uint8]) -> Level:
    arrays = {name: _map(group[name], kind, mapped) for name, kind in LEVEL_DATASETS.items()}
    grid = AngularGrid(ring_cells=np.array(arrays["ring_cells"]))
    mixture = TubeMixture(**{name: arrays[name] for name in FIELD_SHAPES})
    shapes = {name: (len(mixture), *shape) for name, shape in FIELD_SHAPES.items()}
    shapes |= {"cell_offsets": (grid.num_cells + 1,), "cell_log_mass": (grid.num_cells,)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{group.name}/{name} has the shape {arrays[name].shape}, not {shape}")
    log_balance = _map(group["log_balance"], LOG_BALANCE, mapped) if "log_balance" in group else UNBALANCED
    if len(log_balance) not in (0, len(mixture)):
        raise ValueError(f"{group.name}/log_balance has {len(log_balance)} entries, not {len(mixture)}")
    steps = np.diff(arrays["cell_offsets"], prepend=0, append=len(mixture))
    if steps[0] != 0 or steps[-1] != 0 or np.any(steps < 0):
        raise ValueError(f"{group.name}/cell_offsets do not run from 0 to {len(mixture)}")
    return Level(
        window=float(np.deg2rad(group.attrs["window_deg"])),
        grid=grid,
        cell_offsets=arrays["cell_offsets"],
        cell_log_mass=arrays["cell_log_mass"],
        mixture=mixture,
        log_balance=log_balance,
    )


def _read_update(group: h5py.Group, levels: tuple[Level, ...], mapped: NDArray[np.uint8]) -> Update | None:
    if "exact_part_id" not in group.attrs:
        return None
    changes = tuple(_map(group[f"levels/{n}/cell_change"], CELL_CHANGE, mapped) for n in range(len(levels)))
    for n, (change, level) in enumerate(zip(changes, levels, strict=True)):
        if len(change) != level.num_cells:
            raise ValueError(f"{group.name}/levels/{n}/cell_change has {len(change)} entries, not {level.num_cells}")
    return Update(
        exact_part_id=str(group.attrs["exact_part_id"]),
        former_part_id=str(group.attrs["former_part_id"]),
        tolerance=float(group.attrs["update_tolerance"]),
        cell_change=changes,
    )


def _read_scene(file: h5py.File, mapped: NDArray[np.uint8]) -> Scene:
    arrays = {name: _map(file[name], kind, mapped) for name, kind in SCENE_DATASETS.items()}
    free_space = file["scene/free_space"]
    return Scene(
        vertices=arrays["scene/vertices_m"],
        faces=arrays["scene/faces"],
        face_materials=arrays["scene/face_materials"],
        materials=tuple(json.loads(file["scene"].attrs["materials"])),
        free_space=FreeSpace(
            origin=np.asarray(free_space.attrs["origin_m"], dtype=np.float64),
            voxel_size=float(free_space.attrs["voxel_size_m"]),
            free=arrays["scene/free_space"].view(np.bool_),
        ),
        sha256=str(file.attrs["scene_sha256"]),
    )


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return (x, y, z)


def _one_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
