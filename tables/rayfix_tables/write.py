"""Write table files: under a temporary name, with checksums, synced, then renamed to the final name."""

import contextlib
import io
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.compact.tubes import COMPACT_FIELDS
from rayfix_tables.disk.calibrated import CALIBRATION, calibration_text
from rayfix_tables.disk.files import has_signature, why_not_regular
from rayfix_tables.disk.ownership import own_file, remove_abandoned, try_lock
from rayfix_tables.disk.schema import (
    FORMAT,
    FORMAT_VERSION,
    PATH_DATASETS,
    WHOLE_VERSION,
    array_digest,
    bias_attributes,
    content_attributes,
    content_id,
    dataset_paths,
    level_path,
    paths_path,
    read_text,
    write_text,
)
from rayfix_tables.disk.selected import SELECTION, selection_text
from rayfix_tables.errors import RayfixError, TableError
from rayfix_tables.level import Level
from rayfix_tables.mixture import FIELD_SHAPES, TubeMixture
from rayfix_tables.part import StationPart, Update
from rayfix_tables.paths import COMPACT_SEQUENCE, COMPACT_WEIGHT, PathMap
from rayfix_tables.scene import Scene
from rayfix_tables.site import SiteInfo, Station

_LIBVER = ("v108", "v108")
"""Version of HDF5's own structures: since 1.8 they have checksums, and damage is detected."""

_LOOKS, _LOOK_SECONDS = 5, 0.05
"""Attempts at a lock, which another build holds briefly while it renames its table."""


def check_folder(path: Path, error: type[RayfixError]) -> None:
    """Raise an error of the given class if the folder of a new file is missing or read-only."""
    if not path.parent.is_dir():
        raise error(f"cannot write {path}: there is no folder {path.parent}; create it first")
    if not os.access(path.parent, os.W_OK):
        raise error(f"cannot write {path}: the folder {path.parent} is read-only; choose another")


def check_writable(path: Path) -> None:
    """Check before the work that a table can be written.

    Raises
    ------
    TableError
        When a table cannot be written under this name.
    """
    if path.is_dir():
        raise TableError(f"cannot write {path}: it is a folder; give a file name such as {path / 'table.h5'}")
    check_folder(path, TableError)
    if (what := why_not_regular(path)) is not None:
        raise TableError(f"cannot write {path}: it {what}; give another name, or remove it first")
    if path.exists() and path.stat().st_size and not _is_hdf5(path):
        # A table may only replace a table, not, by mistake, a site file or a scene.
        raise TableError(f"cannot write {path}: the file there is not a table; give another name, or remove it first")
    if path.exists() and _is_being_written(path):
        raise TableError(
            f"cannot write {path}: another program has locked it to write to it; end that, or give another name"
        )


def _is_being_written(path: Path) -> bool:
    """Whether a program holds HDF5's writer lock on a file. Readers may continue with the old file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        for _ in range(_LOOKS):
            if try_lock(descriptor, shared=True) is not False:
                return False
            time.sleep(_LOOK_SECONDS)
        return True
    finally:
        os.close(descriptor)


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        return has_signature(file.fileno(), path.stat().st_size)


def write_table(
    path: Path,
    *,
    site: SiteInfo,
    scene: Scene,
    parts: Sequence[StationPart],
    software_version: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> str:
    """Write a table file and return its ``table_id``.

    It has version 5 of the format where components and path maps are compact, and version 4 where none is.

    ``path`` is replaced only when the whole table is on disk; a former file there remains until then.

    Parameters
    ----------
    parts : sequence of StationPart
        Parts of ``site.stations``, in the same order.
    progress : callable, optional
        Called with the number of bytes written so far, and the total.

    Raises
    ------
    ValueError
        When the parts belong to other stations, or some are compact and others are not.
    TableError
        When the disk is full or the folder cannot be written; no partial file is left.
    """
    if [part.station for part in parts] != list(site.stations):
        raise ValueError("the parts of a table are those of its site's stations, in their order")
    version = _version(parts)
    remove_abandoned(path.parent, f".{path.name}.partial-")
    partial = None
    try:
        partial, descriptor = own_file(path.parent, f".{path.name}.partial-")
        with _Sink(descriptor, "w+") as sink:
            try:
                with h5py.File(sink, "w", libver=_LIBVER, alignment_threshold=1, alignment_interval=64) as file:
                    table_id = _write_content(file, version, site, scene, parts, software_version, progress)
            finally:
                sink.raise_failure()
            os.fsync(sink.fileno())
            partial.replace(path)  # while the lock still marks it as in use
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except (OSError, RuntimeError) as error:
        raise TableError(
            f"cannot write {path}: {_first_line(error)}; free some space or choose another folder"
        ) from error
    finally:
        if partial is not None:
            with contextlib.suppress(OSError):
                partial.unlink()
    return table_id


def _version(parts: Sequence[StationPart]) -> int:
    """Version of the format that holds these parts."""
    levels = [level.is_compact for part in parts for level in part.levels]
    maps = [part.paths.is_compact for part in parts if part.paths is not None]
    if len({*levels, *maps}) > 1:
        raise ValueError("some components or path maps of the table are compact, others are not")
    return FORMAT_VERSION if all(levels) else WHOLE_VERSION


class _Sink(io.FileIO):
    """File object that hides failures of writes from HDF5.

    After a failed write (a full disk), HDF5 crashes the process or prints tracebacks at exit. Therefore the first
    failure, or Ctrl-C, is stored, nothing more is written, and the failure is raised after HDF5 has finished.
    """

    _failure: BaseException | None = None

    def write(self, data: Any, /) -> int:
        """Write all bytes."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self._failure is None:
                rest = rest[super().write(rest) :]
        except BaseException as error:
            self._failure = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Change the file's size."""
        try:
            if self._failure is None:
                super().truncate(size)
        except BaseException as error:
            self._failure = error
        return size or 0

    def raise_failure(self) -> None:
        """Raise the first failure, if there was one."""
        if self._failure is not None:
            raise self._failure


def _write_content(
    file: h5py.File,
    version: int,
    site: SiteInfo,
    scene: Scene,
    parts: Sequence[StationPart],
    software_version: str,
    progress: Callable[[int, int], None],
) -> str:
    total, done = sum(part.num_bytes for part in parts), 0
    progress(done, total)
    _write_json(file, "site", _site_document(site))
    _write_scene(file, scene)
    for part in parts:
        _write_part(file, part, scene.origin)
        done += part.num_bytes
        progress(done, total)
    file.attrs["format_version"] = version
    for name, text in (("format", FORMAT), ("software_version", software_version), ("scene_sha256", scene.sha256)):
        write_text(file, name, text)
    digests = {name: read_text(file[name], "sha256") for name in dataset_paths(file)}
    table_id = content_id(content_attributes(file), digests)
    write_text(file, "table_id", table_id)
    return table_id


def _write_part(file: h5py.File, part: StationPart, origin: NDArray[np.float64]) -> None:
    station = part.station
    group = file.create_group(f"stations/{station.id}")
    group.attrs["position_m"] = np.asarray(station.position) - origin
    group.attrs["orientation_deg"] = np.rad2deg(station.orientation)
    group.attrs["field_of_view_deg"] = float(np.rad2deg(station.field_of_view))
    if station.mounting != Station.mounting:  # otherwise the table_id of older tables would change
        write_text(group, "mounting", station.mounting)
    for name, value in bias_attributes(station.bias).items():
        group.attrs[name] = value
    calibration = calibration_text(station)
    if calibration is not None:
        write_text(group, CALIBRATION, calibration)
    if station.selection is not None:
        write_text(group, SELECTION, selection_text(station.selection))
    write_text(group, "part_id", part.part_id)
    group.attrs["lost_ray_share"] = part.lost_ray_share
    group.attrs["coverage"] = np.asarray(part.coverage)
    if part.wall_coverage:
        group.attrs["wall_coverage"] = np.asarray(part.wall_coverage)
        group.attrs["cut_power_share"] = part.cut_power_share
    for n, level in enumerate(part.levels):
        _write_level(file.create_group(level_path(station.id, n)), level)
    if part.update is not None:
        _write_update(group, part.update)
    if part.paths is not None:
        _write_paths(file.create_group(paths_path(station.id)), part.paths)


def _write_scene(file: h5py.File, scene: Scene) -> None:
    group = file.create_group("scene")
    if scene.origin.any():
        group.attrs["origin_m"] = scene.origin
        scene = scene.in_table_frame
    _write_json(group, "materials", scene.materials)
    _write(group, "vertices_m", scene.vertices.astype(np.float64))
    _write(group, "faces", scene.faces.astype(np.int32))
    _write(group, "face_materials", scene.face_materials.astype(np.int16))
    if scene.face_thickness is not None:
        _write(group, "face_thickness_m", np.nan_to_num(scene.face_thickness))
    free_space = _write(group, "free_space", scene.free_space.free.astype(np.uint8))
    free_space.attrs["origin_m"] = scene.free_space.origin
    free_space.attrs["voxel_size_m"] = scene.free_space.voxel_size


def _write_level(group: h5py.Group, level: Level) -> None:
    group.attrs["window_deg"] = float(np.rad2deg(level.window))
    if level.is_compact:  # the unit of angles, to the last bit
        group.attrs["window_rad"] = level.window
    _write(group, "ring_cells", level.grid.ring_cells.astype(np.int64))
    _write(group, "cell_offsets", level.cell_offsets.astype(np.int64))
    _write(group, "cell_log_mass", level.cell_log_mass.astype(np.float64))
    mixture, balance_name = level.mixture, "log_balance16" if level.is_compact else "log_balance"
    stored = mixture.as_stored() if isinstance(mixture, TubeMixture) else mixture
    for name in COMPACT_FIELDS if level.is_compact else FIELD_SHAPES:
        if name != "num_walls" or stored.num_walls.any():
            _write(group, name, getattr(stored, name))
    if len(level.log_balance):
        _write(group, balance_name, level.log_balance.astype(np.float16 if level.is_compact else np.float32))


def _write_paths(group: h5py.Group, paths: PathMap) -> None:
    group.attrs["origin_m"] = paths.origin
    group.attrs["voxel_size_m"] = paths.voxel_size
    group.attrs["shape"] = np.array(paths.shape)
    compact = {}
    if paths.is_compact:
        group.attrs["weight_unit"] = paths.weight_unit
        compact["weight"] = COMPACT_WEIGHT
        if paths.sequence.dtype == np.uint16:
            compact["sequence"] = COMPACT_SEQUENCE
    for name, (dtype, _) in PATH_DATASETS.items():
        array = getattr(paths, name)
        _write(group, compact.get(name, name), array if name in compact else array.astype(dtype))


def _write_update(group: h5py.Group, update: Update) -> None:
    write_text(group, "exact_part_id", update.exact_part_id)
    write_text(group, "former_part_id", update.former_part_id)
    group.attrs["update_tolerance"] = update.tolerance
    for n, change in enumerate(update.cell_change):
        _write(group[f"levels/{n}"], "cell_change", change.astype(np.float32))


def _write_json(group: h5py.Group, name: str, document: Any) -> None:
    _write(group, name, np.frombuffer(json.dumps(document, sort_keys=True).encode(), np.uint8))


def _write(group: h5py.Group, name: str, array: NDArray[Any]) -> h5py.Dataset:
    dataset = group.create_dataset(name, data=array)
    write_text(dataset, "sha256", array_digest(array))
    return dataset


def _site_document(site: SiteInfo) -> dict[str, Any]:
    return {
        "name": site.name,
        "north_deg": float(np.rad2deg(site.north)),
        "max_path_length_m": site.max_path_length,
        "station_ids": [station.id for station in site.stations],
        "document": site.document,
    }


def _first_line(error: BaseException) -> str:
    """Shorten HDF5's message to one line."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    return str(error).splitlines()[0] if str(error) else type(error).__name__
