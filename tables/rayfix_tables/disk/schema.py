"""Layout of a table file: names, types, and the checksum of its content. docs/table-format.md draws the whole."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any, cast, get_args

import h5py
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.compact.tubes import COMPACT_FIELDS
from rayfix_tables.mixture import FIELD_DTYPES, FIELD_SHAPES
from rayfix_tables.paths import COMPACT_PATH_FIELDS, PATH_FIELDS
from rayfix_tables.site import NO_BIAS, Mounting, Station, StationBias

FORMAT = "rayfix-table"
FORMAT_VERSION = 5
"""Version that a build writes: its components and path maps are compact."""

WHOLE_VERSION = 4
"""Last version whose components and path maps are not; of these it is written still."""

TEXT_IN_HEAPS = 1
"""Oldest version that is also read: its texts are attributes of variable length, stored in a heap of the file."""

READ_VERSIONS = (TEXT_IN_HEAPS, 2, 3, WHOLE_VERSION, FORMAT_VERSION)

ARRAYS_VERSION = 2
"""Version of the meaning of a part's arrays: 1 until version 4 of the format, whose parts are not reused."""

TEXT_DATASETS: dict[str, tuple[type[np.generic], int]] = {"site": (np.uint8, 1), "scene/materials": (np.uint8, 1)}
"""Type and number of axes of the datasets that hold JSON, in UTF-8."""

SCENE_DATASETS: dict[str, tuple[type[np.generic], int]] = {
    "scene/vertices_m": (np.float64, 2),
    "scene/faces": (np.int32, 2),
    "scene/face_materials": (np.int16, 1),
    "scene/free_space": (np.uint8, 3),
}
"""Type and number of axes of the scene's datasets."""

CELL_DATASETS: dict[str, tuple[type[np.generic], int]] = {
    "ring_cells": (np.int64, 1),
    "cell_offsets": (np.int64, 1),
    "cell_log_mass": (np.float64, 1),
}
"""Type and number of axes of the datasets of a level's cells."""

LEVEL_DATASETS: dict[str, tuple[type[np.generic], int]] = {
    **CELL_DATASETS,
    **{name: (FIELD_DTYPES[name], 1 + len(shape)) for name, shape in FIELD_SHAPES.items() if name != "num_walls"},
}
"""Type and number of axes of a level's datasets."""

COMPACT_LEVEL_DATASETS: dict[str, tuple[type[np.generic], int]] = {
    **CELL_DATASETS,
    **{name: (dtype, 1 + len(shape)) for name, (dtype, shape) in COMPACT_FIELDS.items() if name != "num_walls"},
}
"""Type and number of axes of the datasets of a level of compact components."""

FACE_THICKNESS: tuple[type[np.generic], int] = (np.float64, 1)
"""Type and number of axes of ``scene/face_thickness_m``, which only scenes with a known thickness have."""

NUM_WALLS: tuple[type[np.generic], int] = (FIELD_DTYPES["num_walls"], 1)
"""Type and number of axes of a level's ``num_walls``, which only levels with paths through walls have."""

LOG_BALANCE: tuple[type[np.generic], int] = (np.float32, 1)
"""Type and number of axes of a level's ``log_balance``, which only balanced levels have."""

COMPACT_LOG_BALANCE: tuple[type[np.generic], int] = (np.float16, 1)
"""Type and number of axes of ``log_balance16``, which is ``log_balance`` of compact components."""

CELL_CHANGE: tuple[type[np.generic], int] = (np.float32, 1)
"""Type and number of axes of a level's ``cell_change``, which only updated parts have."""


PATH_DATASETS = PATH_FIELDS
"""Type and number of axes of the datasets of a station's path map: since version 3, those of gains since version 4."""

COMPACT_PATH_DATASETS = COMPACT_PATH_FIELDS
"""The same of what a compact path map has instead of some of them: since version 5."""


def level_path(station_id: str, level: int) -> str:
    """Path of a level's group in the file."""
    return f"stations/{station_id}/levels/{level}"


def paths_path(station_id: str) -> str:
    """Path of the group of a station's path map in the file."""
    return f"stations/{station_id}/paths"


def bias_attributes(bias: StationBias) -> dict[str, float]:
    """Attributes of a station's group that hold its bias."""
    return {
        "range_bias_m": bias.range,
        "range_bias_stdev_m": bias.range_stdev,
        "azimuth_bias_deg": float(np.rad2deg(bias.azimuth)),
        "zenith_bias_deg": float(np.rad2deg(bias.zenith)),
        "angle_bias_stdev_deg": float(np.rad2deg(bias.angle_stdev)),
    }


def read_bias(attributes: Mapping[str, Any]) -> StationBias:
    """Bias of a station from the attributes of its group; zero if they are missing.

    Raises
    ------
    ValueError
        When one of them is not a number.
    """
    metres_and_degrees = [attributes.get(name, 0.0) for name in bias_attributes(NO_BIAS)]
    if not all(isinstance(value, int | float) for value in metres_and_degrees):
        raise ValueError("the bias of a station is not a number")
    azimuth, zenith, angle_stdev = (float(angle) for angle in np.deg2rad(metres_and_degrees[2:]))
    return StationBias(
        range=float(metres_and_degrees[0]),
        range_stdev=float(metres_and_degrees[1]),
        azimuth=azimuth,
        zenith=zenith,
        angle_stdev=angle_stdev,
    )


def write_text(node: h5py.Group | h5py.Dataset, name: str, text: str) -> None:
    """Write an attribute as a text of fixed length, which is stored in the object itself and not in a heap."""
    raw = text.encode()
    node.attrs.create(name, raw, dtype=h5py.string_dtype("utf-8", max(1, len(raw))))


def read_text(node: h5py.Group | h5py.Dataset, name: str) -> str:
    """Read a text attribute of fixed or variable length."""
    return str(_plain(node.attrs[name]))


def read_mounting(attributes: Mapping[str, Any]) -> Mounting:
    """Local frame of a station's array from the attributes of its group; that of 3GPP where it is missing."""
    mounting = attributes.get("mounting", Station.mounting)
    for known in get_args(Mounting):
        if mounting == known:
            return cast("Mounting", known)
    raise ValueError(f"mounting is {mounting!r}; this version supports {', '.join(get_args(Mounting))}")


def array_digest(array: NDArray[Any]) -> str:
    """SHA-256 of an array: type, shape and bytes in C order, little-endian."""
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(array.reshape(-1).view(np.uint8).data if array.size else b"")
    return digest.hexdigest()


def content_id(attributes: Mapping[str, Any], digests: Mapping[str, str]) -> str:
    """``table_id``: SHA-256 of everything that influences an answer.

    Parameters
    ----------
    attributes : mapping
        The attributes that :func:`content_attributes` gathers.
    digests : mapping of dataset path to SHA-256
    """
    document = json.dumps([dict(attributes), dict(digests)], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(document.encode()).hexdigest()


def content_attributes(file: h5py.File) -> dict[str, Any]:
    """Collect the attributes that belong to the content, by path; without checksums, author and time of writing."""
    gathered: dict[str, dict[str, Any]] = {"": dict(file.attrs)}
    file.visititems(lambda name, node: gathered.update({name: dict(node.attrs)}))
    return content_of(
        {path: {key: _plain(value) for key, value in attributes.items()} for path, attributes in gathered.items()}
    )


def _plain(value: Any) -> Any:
    """Return an attribute as JSON-compatible data."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    return value.decode() if isinstance(value, bytes) else value


def content_of(attributes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Select the attributes that belong to the content, by path of their object; the root is ``""``."""
    found = {
        f"{path}@{key}": value
        for path, each in attributes.items()
        for key, value in each.items()
        if path and key != "sha256"
    }
    for key in ("format", "format_version", "site", "scene_sha256"):
        if key in attributes[""]:  # the site is a dataset since version 2
            found[f"@{key}"] = str(attributes[""][key])
    return found


def dataset_paths(file: h5py.File) -> Iterable[str]:
    """Paths of all datasets, sorted."""
    paths: list[str] = []
    file.visititems(lambda name, node: paths.append(name) if isinstance(node, h5py.Dataset) else None)
    return sorted(paths)
