"""The paths from a station to each place: which there are, and which of them the station reports."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

PATH_FIELDS: dict[str, tuple[type[np.generic], int]] = {
    "offsets": (np.int64, 1),
    "sequence": (np.int32, 1),
    "weight": (np.float32, 1),
    "excess": (np.float32, 1),
    "num_walls": (np.int8, 1),
    "images": (np.float64, 2),
    "mirrors": (np.float64, 3),
    "num_reflections": (np.int8, 1),
    "log_gain": (np.float16, 1),
    "lit": (np.float16, 1),
}
"""Type and number of axes of the arrays of a path map."""

COMPACT_SEQUENCE, COMPACT_WEIGHT = "sequence16", "weight16"
"""Names in the file of the sequence as uint16, and of the weight as float16 in units of ``weight_unit``."""

COMPACT_PATH_FIELDS: dict[str, tuple[type[np.generic], int]] = {
    COMPACT_SEQUENCE: (np.uint16, 1),
    COMPACT_WEIGHT: (np.float16, 1),
}
"""What a compact map has instead of ``sequence``, where there are not too many, and of ``weight``."""

_UNIT_EXPONENT = -15
"""Of the unit of compact weights, relative to the largest: down to 2e-9 of that they keep half precision."""

_LEAST_WEIGHT = float(np.finfo(np.float16).smallest_subnormal)

GAIN_FIELDS = frozenset({"log_gain", "lit"})
"""Arrays that path maps have since version 4 of the table format; earlier ones have none of them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PathMap:
    """Paths from one station to the voxels of a map.

    A path of reflection sequence s to a position x has the length ``|x - image_s|``, the direction ``k`` of ``x -
    image_s`` when it arrives, and left the station in the direction ``mirror_s' k``. This holds for any x; the voxels
    tell only which sequences there are.

    Attributes
    ----------
    origin : ndarray of shape (3,), m
        Low corner of the map.
    voxel_size : float, m
    shape : tuple of 3 ints
    offsets : ndarray of int64, shape (n_voxels + 1,)
        The paths to voxel v, in C order, are those from ``offsets[v]`` to ``offsets[v + 1]``, heaviest first.
    sequence : ndarray of int32, shape (n_paths,)
        In a compact map uint16, if there are few enough.
    weight : ndarray of float32, shape (n_paths,)
        In a compact map float16 in units of ``weight_unit``; :attr:`weight_of_1` is that of either. Positive. With the
        path prior "power", it is the probability that the station reports this path, and those of a voxel add up to 1.
    excess : ndarray of float32, shape (n_paths,) or (0,), m
        What the walls that a path passes add to its measured length; empty where no path passes any.
    num_walls : ndarray of int8, shape (n_paths,) or (0,)
        Walls that a path passes, the mean over the voxel.
    images : ndarray of float64, shape (n_sequences, 3), m
        Mirror images of the station.
    mirrors : ndarray of float64, shape (n_sequences, 3, 3)
        Turn a direction at the station into the one after the last reflection.
    num_reflections : ndarray of int8, shape (n_sequences,)
    log_gain : ndarray of float16, shape (n_paths,) or (0,)
        Natural logarithm of the power gain relative to free space of the path's length, the mean over the voxel. Empty
        in tables of former versions.
    lit : ndarray of float16, shape (n_paths,) or (0,)
        Fraction of the voxel's free part that the path reaches; empty as ``log_gain``.
    weight_unit : float
        1 unless the map is compact.
    """

    origin: NDArray[np.float64]
    voxel_size: float
    shape: tuple[int, ...]
    offsets: NDArray[np.int64]
    sequence: NDArray[np.int32] | NDArray[np.uint16]
    weight: NDArray[np.float32] | NDArray[np.float16]
    excess: NDArray[np.float32]
    num_walls: NDArray[np.int8]
    images: NDArray[np.float64]
    mirrors: NDArray[np.float64]
    num_reflections: NDArray[np.int8]
    log_gain: NDArray[np.float16]
    lit: NDArray[np.float16]
    weight_unit: float = 1.0

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.sequence)

    @property
    def is_compact(self) -> bool:
        """Whether the weights are compact."""
        return self.weight.dtype == np.float16

    @property
    def weight_of_1(self) -> NDArray[np.float32]:
        """Weights in single precision, in units of 1, shape (n_paths,)."""
        if not self.is_compact:
            return self.weight.astype(np.float32, copy=False)
        weight = self.weight.astype(np.float32)
        weight *= np.float32(self.weight_unit)  # a power of two
        return weight

    @property
    def compacted(self) -> "PathMap":
        """The map with compact sequences and weights.

        Weights below 2e-12 of the largest are raised to it: they remain positive.
        """
        if self.is_compact:
            return self
        exponent = math.frexp(float(self.weight.max(initial=0.0)))[1] + _UNIT_EXPONENT
        unit = math.ldexp(1.0, exponent)
        few = len(self.images) <= np.iinfo(np.uint16).max + 1
        return replace(
            self,
            sequence=self.sequence.astype(np.uint16) if few else self.sequence,
            weight=np.maximum(self.weight.astype(np.float64) / unit, _LEAST_WEIGHT).astype(np.float16),
            weight_unit=unit,
        )

    def rearranged(self, offsets: NDArray[np.int64], source: NDArray[np.int64], lit: NDArray[np.floating]) -> "PathMap":
        """Return a map of copies of these paths, to other voxels too, with weights of 0.

        Parameters
        ----------
        offsets : ndarray of int64, shape (n_voxels + 1,)
            Of the new map.
        source : ndarray of int64, shape (n,)
            The path that each of its paths is a copy of.
        lit : ndarray of shape (n,)
        """
        passes = len(self.excess) > 0
        return replace(
            self,
            offsets=offsets,
            sequence=self.sequence[source],
            weight=np.zeros(len(source), np.float32),
            weight_unit=1.0,
            excess=self.excess[source] if passes else self.excess,
            num_walls=self.num_walls[source] if passes else self.num_walls,
            log_gain=self.log_gain[source],
            lit=lit.astype(np.float16),
        )

    @property
    def num_bytes(self) -> int:
        """Size of the arrays in the file."""
        return sum(getattr(self, name).nbytes for name in PATH_FIELDS)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the map as arrays, by names that begin with ``paths_``."""
        box = {"origin": self.origin, "voxel_size": np.array(self.voxel_size), "shape": np.array(self.shape)}
        box["weight_unit"] = np.array(self.weight_unit)
        arrays = box | {name: getattr(self, name) for name in PATH_FIELDS}
        return {f"paths_{name}": array for name, array in arrays.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "PathMap":
        """Restore a map from the arrays of :meth:`to_arrays`, among others."""
        return cls(
            origin=arrays["paths_origin"],
            voxel_size=float(arrays["paths_voxel_size"]),
            shape=tuple(arrays["paths_shape"].tolist()),
            weight_unit=float(arrays["paths_weight_unit"]),
            **{name: arrays[f"paths_{name}"] for name in PATH_FIELDS},
        )
