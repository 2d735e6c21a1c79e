"""Components of a level in 67 bytes each instead of 117, balance included: what a table holds, and workers share.

Most numbers have half precision, an error of at most 1 in 2048. They are in units in which they are neither large nor
small, whatever the scene: angles in windows, and how a place moves with the angle in path lengths. Covariances are
lower triangular roots, so that they remain positive definite. A path length and a place keep single precision.

What rounds u_mean moves x_mean along the tube: which place belongs to which length and angle is as before.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.mixture import TubeMixture, pack, unpack

COMPACT_FIELDS: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "log_weight16": (np.uint16, ()),
    "length": (np.float32, ()),
    "angles16": (np.float16, (2,)),
    "u_root16": (np.float16, (6,)),
    "x_mean": (np.float32, (3,)),
    "slopes16": (np.float16, (3, 3)),
    "x_root16": (np.float16, (6,)),
    "num_reflections": (np.int8, ()),
    "num_walls": (np.int8, ()),
}
"""Type of each field in the file, and shape of one component's entry."""

WEIGHT_STEPS = 1024.0
"""Steps of the logarithm of a weight in a unit."""

DIAGONAL = (0, 2, 5)
"""Places of the diagonal of a root: 00 10 11 20 21 22."""

LEAST_DIAGONAL = 2.0**-14
"""Smallest number of half precision that keeps its relative precision."""

_LARGEST = float(np.finfo(np.float16).max)
_LOWER = np.tril_indices(3)


class CompactArrays(NamedTuple):
    """The arrays of :class:`CompactTubes` for kernels, which cannot take half precision: its bits as whole numbers."""

    log_weight16: NDArray[np.uint16]
    length: NDArray[np.float32]
    angles16: NDArray[np.uint16]
    u_root16: NDArray[np.uint16]
    x_mean: NDArray[np.float32]
    slopes16: NDArray[np.uint16]
    x_root16: NDArray[np.uint16]


@dataclass(frozen=True, kw_only=True)
class CompactTubes:
    """Components of one or many cells, component axis first; read as a :class:`~rayfix_tables.mixture.TubeMixture`.

    Attributes
    ----------
    window : float, rad
        Unit of angles.
    log_weight16 : ndarray of uint16, shape (n,)
        Natural logarithm of the weight times -1024; weights below exp(-64) are raised to that.
    length : ndarray of float32, shape (n,), m
        Path length of u_mean.
    angles16 : ndarray of float16, shape (n, 2), windows
        Tangent angles of u_mean.
    u_root16 : ndarray of float16, shape (n, 6), m and windows
        Lower triangular root of u_cov, row by row.
    x_mean : ndarray of float32, shape (n, 3), m
    slopes16 : ndarray of float16, shape (n, 3, 3)
        ``jacobian``, its last two columns divided by ``length``.
    x_root16 : ndarray of float16, shape (n, 6), m
        Lower triangular root of x_cov, row by row.
    num_reflections, num_walls : ndarray of int8, shape (n,)
    """

    window: float
    log_weight16: NDArray[np.uint16]
    length: NDArray[np.float32]
    angles16: NDArray[np.float16]
    u_root16: NDArray[np.float16]
    x_mean: NDArray[np.float32]
    slopes16: NDArray[np.float16]
    x_root16: NDArray[np.float16]
    num_reflections: NDArray[np.int8]
    num_walls: NDArray[np.int8]

    def __len__(self) -> int:
        """Return the number of components."""
        return len(self.length)

    def __getitem__(self, index: slice | NDArray[Any]) -> TubeMixture:
        """Components of a slice or of an index array, in double precision."""
        return self.take(index).expanded

    def take(self, index: slice | NDArray[Any]) -> "CompactTubes":
        """Components of a slice, without a copy, or of an index array, as they are stored."""
        return CompactTubes(window=self.window, **{name: getattr(self, name)[index] for name in COMPACT_FIELDS})

    @classmethod
    def concatenate(cls, parts: Sequence["CompactTubes"], window: float) -> "CompactTubes":
        """Concatenate the components of all parts, which have this window."""
        if any(part.window != window for part in parts):
            raise ValueError("components of several windows are not one mixture")
        joined = {
            name: np.concatenate([np.zeros((0, *shape), dtype), *(getattr(part, name) for part in parts)])
            for name, (dtype, shape) in COMPACT_FIELDS.items()
        }
        return cls(window=window, **joined)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fields as arrays, by their names."""
        return {"window": np.array(self.window)} | {name: getattr(self, name) for name in COMPACT_FIELDS}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "CompactTubes":
        """Restore components from the arrays of :meth:`to_arrays`, among others."""
        return cls(window=float(arrays["window"]), **{name: arrays[name] for name in COMPACT_FIELDS})

    @property
    def num_bytes(self) -> int:
        """Size of the arrays."""
        return sum(getattr(self, name).nbytes for name in COMPACT_FIELDS)

    @cached_property
    def arrays(self) -> CompactArrays:
        """Arrays that kernels take."""
        fields = (getattr(self, name) for name in CompactArrays._fields)
        return CompactArrays(*(field.view(np.uint16) if field.dtype == np.float16 else field for field in fields))

    @property
    def expanded(self) -> TubeMixture:
        """All components in double precision."""
        return TubeMixture(
            log_weight=self.log_weight,
            u_mean=self.u_mean,
            u_cov=self.u_cov,
            x_mean=self.x_mean.astype(np.float64),
            jacobian=self.jacobian,
            x_cov=self.x_cov,
            num_reflections=self.num_reflections,
            num_walls=self.num_walls,
        )

    @property
    def log_weight(self) -> NDArray[np.float64]:
        """Natural logarithms of the weights, shape (n,)."""
        return self.log_weight16 / -WEIGHT_STEPS

    @property
    def u_mean(self) -> NDArray[np.float64]:
        """Path length [m], horizontal and vertical tangent angle [rad], shape (n, 3)."""
        return np.column_stack([self.length.astype(np.float64), self.angles16.astype(np.float64) * self.window])

    @property
    def u_cov(self) -> NDArray[np.float64]:
        """Packed covariance of u, shape (n, 6)."""
        return pack(_squared(self.u_root16.astype(np.float64) * self._root_units))

    @property
    def x_cov(self) -> NDArray[np.float64]:
        """Packed covariance of x given u, shape (n, 6), m2."""
        return pack(_squared(self.x_root16.astype(np.float64)))

    @property
    def jacobian(self) -> NDArray[np.float64]:
        """Dx / du, shape (n, 3, 3)."""
        slopes = self.slopes16.astype(np.float64)
        slopes[:, :, 1:] *= self.length.astype(np.float64)[:, None, None]
        return slopes

    @property
    def _root_units(self) -> NDArray[np.float64]:
        """Units of the rows of the root of u_cov: the first is a length, the others are angles."""
        return np.array([1.0, *[self.window] * 5])


def compacted(mixture: TubeMixture, window: float) -> CompactTubes:
    """Round components to what a table holds.

    Parameters
    ----------
    mixture : TubeMixture
        Its covariances are positive definite.
    window : float, rad
        Of the level that they belong to.

    Raises
    ------
    ValueError
        When a number is not finite, a covariance is not positive definite, a weight is above 1, or a spread has no
        place in half precision; a build makes none of these.
    """
    log_weight, u_mean, x_mean, jacobian = (
        np.asarray(getattr(mixture, name), np.float64) for name in ("log_weight", "u_mean", "x_mean", "jacobian")
    )
    u_cov, x_cov = (unpack(np.asarray(packed, np.float64)) for packed in (mixture.u_cov, mixture.x_cov))
    for name, array in (("log_weight", log_weight), ("u_mean", u_mean), ("x_mean", x_mean), ("jacobian", jacobian)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name} of a component is not finite")
    if np.any(log_weight * WEIGHT_STEPS > 0.5):
        raise ValueError("the weight of a component is above 1")
    length = u_mean[:, 0].astype(np.float32)
    if np.any(length <= 0.0):
        raise ValueError("the path length of a component is not positive")
    angles = (u_mean[:, 1:] / window).astype(np.float16)
    slopes = jacobian.copy()
    slopes[:, :, 1:] /= length.astype(np.float64)[:, None, None]
    cut = np.max(np.abs(slopes), axis=(1, 2), initial=0.0) > _LARGEST
    slopes16 = np.clip(slopes, -_LARGEST, _LARGEST).astype(np.float16)
    found = CompactTubes(
        window=window,
        log_weight16=np.clip(np.rint(-WEIGHT_STEPS * log_weight), 0, np.iinfo(np.uint16).max).astype(np.uint16),
        length=length,
        angles16=angles,
        u_root16=_root(u_cov, np.array([1.0, window, window])),
        x_mean=np.zeros((len(length), 3), np.float32),
        slopes16=slopes16,
        x_root16=np.zeros((len(length), 6), np.float16),
        num_reflections=np.asarray(mixture.num_reflections, np.int8),
        num_walls=np.asarray(mixture.num_walls, np.int8),
    )
    # What a slope beyond half precision would have said becomes a spread of the place.
    lost = np.where(np.reshape(cut, (-1, 1, 1)), found.jacobian - jacobian, 0.0)
    x_cov = x_cov + lost @ u_cov @ lost.transpose(0, 2, 1)
    moved = np.einsum("nij,nj->ni", jacobian, found.u_mean - u_mean)
    fields = {name: getattr(found, name) for name in COMPACT_FIELDS}
    fields |= {"x_mean": (x_mean + moved).astype(np.float32), "x_root16": _root(x_cov, np.ones(3))}
    return CompactTubes(window=window, **fields)


def _root(cov: NDArray[np.float64], units: NDArray[np.float64]) -> NDArray[np.float16]:
    """Lower triangular roots of covariances of shape (n, 3, 3), in these units, row by row, shape (n, 6).

    Written out: LAPACK's last digits differ from one version to the next.
    """
    c = cov / (units[:, None] * units)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        l00 = np.sqrt(c[:, 0, 0])
        l10, l20 = c[:, 1, 0] / l00, c[:, 2, 0] / l00
        l11 = np.sqrt(c[:, 1, 1] - l10 * l10)
        l21 = (c[:, 2, 1] - l20 * l10) / l11
        l22 = np.sqrt(c[:, 2, 2] - l20 * l20 - l21 * l21)
        root = np.stack([l00, l10, l11, l20, l21, l22], axis=1)
        if not np.isfinite(root).all() or not np.all(root[:, DIAGONAL] > 0.0):
            raise ValueError("a covariance of a component is not positive definite")
        root[:, DIAGONAL] = np.maximum(root[:, DIAGONAL], LEAST_DIAGONAL)
        stored = root.astype(np.float16)
    if not np.isfinite(stored).all():
        raise ValueError(f"a component is wider than {_LARGEST:.0f} m or windows")
    return stored


def _squared(root: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariances of shape (n, 3, 3) of roots of shape (n, 6)."""
    lower = np.zeros((len(root), 3, 3))
    lower[:, _LOWER[0], _LOWER[1]] = root
    # One product at a time: a library of linear algebra may round otherwise on another machine.
    return np.asarray(sum(lower[:, :, None, k] * lower[:, None, :, k] for k in range(3)))
