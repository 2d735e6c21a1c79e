"""Mixtures of ray tubes, the content of a table's cells.

A component is a Gaussian over the ray coordinates u = (path length L, angles a), the angles in the cell's tangent
plane, and a map from u to the position x. With d = u - u_mean::

    u     ~ N(u_mean, u_cov)
    x | u ~ N(x_mean + jacobian d + widening, x_cov)
    widening = jacobian_a (d_L d_a - u_cov_La) / L_mean

A change of the angle moves the far end of a tube further than its near end, in proportion to the path length. This is
the widening; its mean is zero. It needs no parameters: the last two columns of the jacobian are its slopes at the mean
length. Without it, a component's x_cov would have to include the spread of its rays' directions, and angles much more
accurate than the window would be under-weighted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rayfix_tables.gaussians.definite import rounded_definite

FIELD_SHAPES: dict[str, tuple[int, ...]] = {
    "log_weight": (),
    "u_mean": (3,),
    "u_cov": (6,),
    "x_mean": (3,),
    "jacobian": (3, 3),
    "x_cov": (6,),
    "num_reflections": (),
    "num_walls": (),
}
"""Shape of one component's entry in each field; symmetric matrices are packed by :func:`pack`."""

FIELD_DTYPES: dict[str, type[np.generic]] = {
    name: (np.int8 if name.startswith("num_") else np.float32) for name in FIELD_SHAPES
}
"""Type of each field on disk."""

_UPPER = np.triu_indices(3)
_UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def pack(matrices: NDArray[Any]) -> NDArray[Any]:
    """Pack symmetric matrices of shape (..., 3, 3) into their upper triangles, row by row, shape (..., 6)."""
    return matrices[..., _UPPER[0], _UPPER[1]]


def unpack(packed: NDArray[Any]) -> NDArray[Any]:
    """Unpack the result of :func:`pack`."""
    return packed[..., _UNPACK]


def widening_cov(u_mean: NDArray[Any], u_cov: NDArray[Any], jacobian: NDArray[Any]) -> NDArray[np.float64]:
    """Covariance that the widening adds to the position of components.

    For Gaussian d_L and d_a, ``cov(d_L d_a) = cov_LL cov_aa + cov_La cov_aL``. The widening is uncorrelated with u.

    Parameters
    ----------
    u_mean : ndarray of shape (n, 3)
    u_cov : ndarray of shape (n, 3, 3)
    jacobian : ndarray of shape (n, 3, 3)

    Returns
    -------
    ndarray of shape (n, 3, 3), m2
    """
    u_mean, u_cov, slopes = (np.asarray(a, np.float64) for a in (u_mean, u_cov, jacobian[:, :, 1:]))
    across = u_cov[:, 0, 1:]
    products = u_cov[:, :1, :1] * u_cov[:, 1:, 1:] + across[:, :, None] * across[:, None, :]
    slopes = slopes / u_mean[:, :1, None]
    return np.asarray(slopes @ products @ slopes.transpose(0, 2, 1))


class Tubes(NamedTuple):
    """The arrays of a :class:`TubeMixture` for kernels, which cannot take dataclasses."""

    log_weight: NDArray[Any]
    u_mean: NDArray[Any]
    u_cov: NDArray[Any]
    x_mean: NDArray[Any]
    jacobian: NDArray[Any]
    x_cov: NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class TubeMixture:
    """Components of one or many cells, component axis first.

    Attributes
    ----------
    log_weight : ndarray of shape (n,)
        Natural logarithms; the weights of one cell sum to 1.
    u_mean : ndarray of shape (n, 3)
        Path length [m], horizontal and vertical tangent angle [rad].
    u_cov : ndarray of shape (n, 6)
        Packed covariance of u.
    x_mean : ndarray of shape (n, 3), m
    jacobian : ndarray of shape (n, 3, 3)
        dx / du.
    x_cov : ndarray of shape (n, 6), m2
        Packed covariance of x given u, in addition to the widening.
    num_reflections : ndarray of int8, shape (n,)
        Reflections of the path that carries most of the component.
    num_walls : ndarray of int8, shape (n,)
        Walls that this path passes.
    """

    log_weight: NDArray[Any]
    u_mean: NDArray[Any]
    u_cov: NDArray[Any]
    x_mean: NDArray[Any]
    jacobian: NDArray[Any]
    x_cov: NDArray[Any]
    num_reflections: NDArray[Any]
    num_walls: NDArray[Any]

    def __len__(self) -> int:
        """Return the number of components."""
        return len(self.log_weight)

    @property
    def tubes(self) -> "Tubes":
        """Arrays that kernels take."""
        return Tubes(self.log_weight, self.u_mean, self.u_cov, self.x_mean, self.jacobian, self.x_cov)

    @property
    def num_bytes(self) -> int:
        """Size of the arrays."""
        return sum(getattr(self, name).nbytes for name in FIELD_SHAPES)

    def __getitem__(self, index: slice | NDArray[Any]) -> "TubeMixture":
        """Components of a slice, without a copy, or of an index array."""
        return TubeMixture(**{name: getattr(self, name)[index] for name in FIELD_SHAPES})

    @classmethod
    def empty(cls) -> "TubeMixture":
        """Return a mixture without components."""
        return cls(**{name: np.zeros((0, *shape), FIELD_DTYPES[name]) for name, shape in FIELD_SHAPES.items()})

    @classmethod
    def concatenate(cls, parts: Sequence["TubeMixture"]) -> "TubeMixture":
        """Concatenate the components of all parts."""
        if not parts:
            return cls.empty()
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)})

    def as_stored(self) -> "TubeMixture":
        """Return the same mixture in the types of the table file.

        Covariances that are positive definite remain so: :func:`~rayfix_tables.gaussians.definite.rounded_definite`.
        """
        arrays = {name: getattr(self, name) for name in FIELD_SHAPES}
        for name in ("u_cov", "x_cov"):
            if arrays[name].dtype != FIELD_DTYPES[name]:
                arrays[name] = pack(rounded_definite(unpack(arrays[name])))
        return TubeMixture(
            **{
                name: np.ascontiguousarray(array, dtype=FIELD_DTYPES[name]).reshape(-1, *FIELD_SHAPES[name])
                for name, array in arrays.items()
            }
        )


def joint_cov(mixture: TubeMixture) -> NDArray[np.float64]:
    """Covariances of (u, x) of a mixture's components, widening included, shape (n, 6, 6); m and rad."""
    u_cov, jacobian = unpack(np.asarray(mixture.u_cov, np.float64)), np.asarray(mixture.jacobian, np.float64)
    across = jacobian @ u_cov
    cov = np.empty((len(mixture), 6, 6))
    cov[:, :3, :3], cov[:, 3:, :3], cov[:, :3, 3:] = u_cov, across, across.transpose(0, 2, 1)
    cov[:, 3:, 3:] = unpack(np.asarray(mixture.x_cov, np.float64)) + across @ jacobian.transpose(0, 2, 1)
    cov[:, 3:, 3:] += widening_cov(mixture.u_mean, u_cov, jacobian)
    return cov
