"""The groups, attributes and array offsets of a table's file, read with HDF5 and checked against the format.

With the layout, a process reads the arrays from the mapped file, without HDF5. The layout is small: the process that
reads it (see :mod:`rayfix_tables.checking`) sends it to those that use the table, because a damaged file can make HDF5
crash or hang.
"""

import errno
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.disk.files import OpenFile
from rayfix_tables.disk.schema import (
    CELL_CHANGE,
    COMPACT_LEVEL_DATASETS,
    COMPACT_LOG_BALANCE,
    COMPACT_PATH_DATASETS,
    FACE_THICKNESS,
    FORMAT,
    LEVEL_DATASETS,
    LOG_BALANCE,
    NUM_WALLS,
    PATH_DATASETS,
    READ_VERSIONS,
    SCENE_DATASETS,
    TEXT_DATASETS,
    TEXT_IN_HEAPS,
)
from rayfix_tables.errors import CorruptTableError, FormatVersionError, NotATableError, TableError

_MOST_ATTRIBUTES = 64  # of one object; a station has 14
_LEAST_OBJECT_BYTES = 16
_LONGEST_ARRAY = 1024  # of an attribute; the coverage of a station is the longest
_OF_THE_SYSTEM = frozenset(
    {
        errno.EACCES, errno.EAGAIN, errno.EBUSY, errno.EHOSTDOWN, errno.EINTR, errno.EIO, errno.EMFILE, errno.ENFILE,
        errno.ENODEV, errno.ENOLCK, errno.ENOSYS, errno.ENOTCONN, errno.ENOTSUP, errno.ENXIO, errno.EPERM,
        errno.EREMOTEIO, errno.ESTALE, errno.ETIMEDOUT,
    }
)  # fmt: skip
"""Errors of disks, networks and permissions, which do not depend on the file's content."""

_STATION = re.compile(r"stations/[^/]+\Z")
_PATHS = re.compile(r"stations/[^/]+/paths\Z")
_LEVEL = re.compile(r"stations/[^/]+/levels/(0|[1-9][0-9]{0,3})\Z")
_OF_SCENE = {**SCENE_DATASETS, **TEXT_DATASETS, "scene/face_thickness_m": FACE_THICKNESS}
_OF_LEVELS = {
    **LEVEL_DATASETS,
    **COMPACT_LEVEL_DATASETS,
    "num_walls": NUM_WALLS,
    "log_balance": LOG_BALANCE,
    "log_balance16": COMPACT_LOG_BALANCE,
    "cell_change": CELL_CHANGE,
}
_OF_PATHS = {**PATH_DATASETS, **COMPACT_PATH_DATASETS}


@dataclass(frozen=True, kw_only=True)
class StoredArray:
    """Location of a dataset in the file.

    Attributes
    ----------
    offset : int
        From the beginning of the file, bytes; 0 for an empty dataset.
    shape : tuple of int
    """

    offset: int
    shape: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class FileLayout:
    """The groups, attributes and datasets of a table's file, by their paths; that of the root is ``""``."""

    attributes: dict[str, dict[str, Any]] = field(default_factory=dict)
    datasets: dict[str, StoredArray] = field(default_factory=dict)

    def to_document(self) -> dict[str, Any]:
        """Return the layout as JSON-compatible data."""
        datasets = {path: [stored.offset, list(stored.shape)] for path, stored in self.datasets.items()}
        return {"attributes": self.attributes, "datasets": datasets}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "FileLayout":
        """Restore a layout from the data of :meth:`to_document`."""
        stored = document["datasets"].items()
        datasets = {path: StoredArray(offset=offset, shape=tuple(shape)) for path, (offset, shape) in stored}
        return cls(attributes=document["attributes"], datasets=datasets)

    def array(self, path: str, mapped: NDArray[np.uint8]) -> NDArray[Any]:
        """View of a dataset in the mapped file."""
        stored, dtype = self.datasets[path], dataset_kind(path)[0]
        num_bytes = math.prod(stored.shape) * dtype.itemsize
        if num_bytes == 0:
            return np.zeros(stored.shape, dtype)
        if stored.offset < 0 or stored.offset + num_bytes > mapped.size:
            raise ValueError(f"{path} is incomplete")
        raw = mapped[stored.offset : stored.offset + num_bytes]
        return raw.view(np.ndarray).view(dtype).reshape(stored.shape)


def dataset_kind(path: str) -> tuple[np.dtype[Any], int]:
    """Type and number of axes of the dataset of a path.

    Raises
    ------
    ValueError
        When a table has no such dataset.
    """
    group, _, name = path.rpartition("/")
    if path in _OF_SCENE:
        kind = _OF_SCENE[path]
    elif _LEVEL.match(group) and name in _OF_LEVELS:
        kind = _OF_LEVELS[name]
    elif _PATHS.match(group) and name in _OF_PATHS:
        kind = _OF_PATHS[name]
    else:
        raise ValueError(f"{shown(path)} does not belong to a table")
    return np.dtype(kind[0]), kind[1]


def shown(text: str) -> str:
    """Format a text of the file for a one-line message."""
    return text if text.isprintable() and len(text) <= 100 else ascii(text[:100])


@contextmanager
def damage_reported(path: Path) -> Iterator[None]:
    """Convert the readers' exceptions on a damaged file into one-line errors.

    A changed byte in HDF5's metadata causes any of these: HDF5 raises OSError, KeyError or RuntimeError, or the readers
    find a wrong type. A TypeError or an AttributeError is a defect of the readers and is not converted.
    """
    try:
        yield
    except MemoryError as error:
        # The claimed sizes are bounded by the file's size, so the file is not the cause.
        raise TableError(
            f"{path} cannot be read: there is not enough memory for it; free some, or use a larger machine"
        ) from error
    except OSError as error:
        if error.errno in _OF_THE_SYSTEM:
            raise TableError(
                f"{path} cannot be read ({os.strerror(error.errno)}); check that its disk is available, then try again"
            ) from error
        raise _damage(path, error) from error
    except (KeyError, OverflowError, RuntimeError, SystemError, ValueError) as error:
        raise _damage(path, error) from error


def _damage(path: Path, error: Exception) -> CorruptTableError:
    if "truncated file" in str(error):  # HDF5's words go on with addresses
        return CorruptTableError(f"{path} is cut short; restore it from a copy or build it again")
    return CorruptTableError(f"{path} is damaged: {_one_line(error)}; restore it from a copy or build it again")


def read_layout(opened: OpenFile) -> FileLayout:
    """Read the layout of a file with HDF5. Call it within :func:`damage_reported`.

    Links, filters, chunks, virtual and external storage, unknown members, and shapes larger than the file are refused
    before any data are read.

    Raises
    ------
    NotATableError
        When another program wrote it.
    FormatVersionError
        When another version of rayfix wrote it.
    ValueError
        When it does not have the structure that rayfix writes.
    """
    path = opened.path
    # Opened by its descriptor, because another file may have its name now. Without a lock, which some file systems lack
    # and another program may hold; a table never changes in place.
    with h5py.File(f"/dev/fd/{opened.descriptor}", "r", locking=False) as file:
        # Damaged texts in a heap can make HDF5 hang; files of later versions must not have any.
        later = [version for version in READ_VERSIONS if version != TEXT_IN_HEAPS]
        reader = _Reader(size=opened.size, in_heaps=_whole_number(file, "format_version") not in later)
        root = reader.attributes_of(file.id, "")
        if root.get("format") != FORMAT:
            raise NotATableError(
                f"{path} is an HDF5 file but not a rayfix table; give a file that 'rayfix build' wrote"
            )
        version = root.get("format_version")
        if version not in READ_VERSIONS or isinstance(version, bool):
            raise FormatVersionError(
                f"{path} has table format {version}, this rayfix reads formats "
                f"{READ_VERSIONS[0]} to {READ_VERSIONS[-1]}; build the table again with this version, or "
                "install the version that wrote it"
            )
        reader.read_group(file["/"].id, "")
        return FileLayout(attributes=reader.attributes, datasets=reader.datasets)


@dataclass(kw_only=True)
class _Reader:
    """Reads the objects of a file and refuses sizes that exceed it.

    Attributes
    ----------
    size : int
        Size of the file, bytes; an upper limit of the claimed sizes.
    in_heaps : bool
        Whether texts may be of variable length.
    """

    size: int
    in_heaps: bool
    attributes: dict[str, dict[str, Any]] = field(default_factory=dict)
    datasets: dict[str, StoredArray] = field(default_factory=dict)
    _array_bytes: int = 0
    _text_bytes: int = 0
    _addresses: set[int] = field(default_factory=set)

    def read_group(self, group: h5py.h5g.GroupID, path: str) -> None:
        """Read all that is under a group."""
        self.attributes_of(group, path)
        for name in self._members(group, path):
            child = f"{path}/{name}" if path else name
            identifier = h5py.h5o.open(group, name.encode())
            if isinstance(identifier, h5py.h5d.DatasetID):
                self._read_dataset(identifier, child)
            elif isinstance(identifier, h5py.h5g.GroupID) and _is_group(child):
                self.read_group(identifier, child)
            else:
                raise ValueError(f"{shown(child)} does not belong to a table")

    def _members(self, group: h5py.h5g.GroupID, path: str) -> list[str]:
        found: list[tuple[bytes, int, Any]] = []

        most = self.size // _LEAST_OBJECT_BYTES

        def visit(name: bytes, info: Any) -> bool | None:
            # h5py does not pass on exceptions of this callback; returning a value ends the visit.
            found.append((name, info.type, info.u))
            return True if len(found) > most else None

        group.links.iterate(visit, info=True)
        if len(found) > most:
            raise ValueError(f"{shown(path or '/')} has more members than fit into the file")
        names = []
        for raw, kind, address in found:
            name = raw.decode("utf-8")
            child = f"{path}/{name}" if path else name
            if kind != h5py.h5l.TYPE_HARD:
                raise ValueError(f"{shown(child)} is a link; a table has none")
            if address in self._addresses:
                raise ValueError(f"{shown(child)} is in the file twice")
            self._addresses.add(address)
            names.append(name)
        return names

    def _read_dataset(self, dataset: h5py.h5d.DatasetID, path: str) -> None:
        dtype, ndim = dataset_kind(path)
        plan, space = dataset.get_create_plist(), dataset.get_space()
        if plan.get_layout() != h5py.h5d.CONTIGUOUS or plan.get_external_count() or plan.get_nfilters():
            raise ValueError(f"{path} is not stored contiguously without a filter")
        if space.get_simple_extent_type() != h5py.h5s.SIMPLE:
            raise ValueError(f"{path} is not an array")
        shape = tuple(int(length) for length in space.get_simple_extent_dims())
        if not dataset.get_type().equal(h5py.h5t.py_create(dtype)) or len(shape) != ndim:
            raise ValueError(f"{path} is {_type_of(dataset)} with {len(shape)} axes, not {dtype} with {ndim}")
        num_bytes = math.prod(shape) * dtype.itemsize
        offset = dataset.get_offset() if num_bytes else 0
        self._array_bytes += num_bytes
        if offset is None or max(*shape, self._array_bytes, offset + num_bytes) > self.size:
            raise ValueError(f"{path} is incomplete")
        self.datasets[path] = StoredArray(offset=offset, shape=shape)
        self.attributes_of(dataset, path)

    def attributes_of(self, identifier: Any, path: str) -> dict[str, Any]:
        """Read the attributes of an object: texts, numbers, and short rows of numbers."""
        if path in self.attributes:
            return self.attributes[path]
        count = h5py.h5a.get_num_attrs(identifier)
        if count > _MOST_ATTRIBUTES:
            raise ValueError(f"{shown(path) or 'the file'} has {count} attributes")
        found: dict[str, Any] = {}
        for index in range(count):
            attribute = h5py.h5a.open(identifier, index=index)
            found[attribute.name.decode()] = self._value(attribute, f"{path}@{attribute.name.decode()}")
        self.attributes[path] = found
        return found

    def _value(self, attribute: h5py.h5a.AttrID, name: str) -> Any:
        kind, space = attribute.get_type(), attribute.get_space()
        is_text = isinstance(kind, h5py.h5t.TypeStringID) and (self.in_heaps or not kind.is_variable_str())
        is_number = isinstance(kind, h5py.h5t.TypeIntegerID | h5py.h5t.TypeFloatID) and kind.get_size() <= 8
        extent = space.get_simple_extent_type()
        scalar = extent == h5py.h5s.SCALAR
        row = extent == h5py.h5s.SIMPLE and space.get_simple_extent_ndims() == 1
        if not (is_text and scalar) and not (is_number and (scalar or row)):
            raise ValueError(f"{shown(name)} is neither a text nor a number")
        if space.get_simple_extent_npoints() > _LONGEST_ARRAY or kind.get_size() > self.size:
            raise ValueError(f"{shown(name)} is too long")
        if is_text:
            text = _text(attribute)
            self._text_bytes += len(text)
            if self._text_bytes > self.size:
                raise ValueError(f"{shown(name)} is too long")
            return text
        values = np.empty(attribute.shape, _type_of(attribute))
        attribute.read(values)
        if not np.all(np.isfinite(values)):
            raise ValueError(f"{shown(name)} is not finite")
        return values.tolist()


def _whole_number(file: h5py.File, name: str) -> int | None:
    """Value of an integer attribute of the file; None for any other value."""
    if not h5py.h5a.exists(file.id, name.encode()):
        return None
    attribute = h5py.h5a.open(file.id, name.encode())
    if not isinstance(attribute.get_type(), h5py.h5t.TypeIntegerID) or attribute.shape != ():
        return None
    value = np.empty((), _type_of(attribute))
    attribute.read(value)
    return int(value)


def _type_of(identifier: Any) -> np.dtype[Any]:
    """Type of an attribute or a dataset."""
    try:
        dtype: np.dtype[Any] = identifier.dtype
    except TypeError as error:  # raised by h5py for types that NumPy does not have
        raise ValueError(str(error)) from error
    return dtype


def _is_group(path: str) -> bool:
    """Whether a table may have such a group."""
    return (
        path in ("scene", "stations")
        or _STATION.match(path) is not None
        or (path.endswith("/levels") and _STATION.match(path.removesuffix("/levels")) is not None)
        or _PATHS.match(path) is not None
        or _LEVEL.match(path) is not None
    )


def _text(attribute: h5py.h5a.AttrID) -> str:
    """Text of an attribute. One that is not Unicode cannot be written into answers."""
    values = np.empty((), _type_of(attribute))
    attribute.read(values)
    value: Any = values[()]
    return value.decode("utf-8") if isinstance(value, bytes) else str(value).encode("utf-8").decode("utf-8")


def _one_line(error: BaseException) -> str:
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return shown(text.splitlines()[0]) if text.strip() else type(error).__name__
