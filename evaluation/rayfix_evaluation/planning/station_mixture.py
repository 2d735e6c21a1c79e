"""The path that a station most probably reports from a position, according to the table.

The cells of a level contain the measure N(a; 0, W) s^2 pi dOmega ds, a density over positions (docs/how-it-works.md):
at a position x, a path k with direction a_k adds N(a_k - c; 0, W) pi_k to the density of the cell with centre c. The
cell with the largest density is therefore near the direction of the path with the largest pi, which is the most
probable report. The sum over all cells times their solid angles is the sum of pi: 1 where the position is audible to
the station, 0 where it is not.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rayfix_tables.geometry.angles import direction, wrap
from rayfix_tables.level import Level
from rayfix_tables.mixture import TubeMixture, joint_cov, unpack

Array = NDArray[np.float64]

AUDIBLE_ABOVE = 0.25
"""A position is audible to a station if the sum of the probabilities of its paths exceeds this.

Mixtures blur shadow boundaries: in the bundled hall the sum is above this at 19 of 20 positions with a path, and below
it at 9 of 10 without.
"""

_REACH = 4.0  # standard deviations, reach of a component
_FLOOR = 1e-3  # m, smallest standard deviation of a component along any axis
_CHUNK = 100_000  # components that are unpacked at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class AudiblePaths:
    """The path that a station most probably reports from each of n positions.

    Attributes
    ----------
    probability : ndarray of shape (n,)
        Sum of pi over all paths; about 1 if there is one.
    azimuth, zenith : ndarray of shape (n,), rad
        Of the reported path; zero, like the following fields, at positions that are not audible.
    path_length : ndarray of shape (n,), m
    gradients : ndarray of shape (n, 3, 3), 1, rad and rad per m
        d(path length, tangent azimuth, zenith) / dx.
    """

    probability: Array
    azimuth: Array
    zenith: Array
    path_length: Array
    gradients: Array

    @property
    def audible(self) -> NDArray[np.bool_]:
        """Whether a position is audible to the station, shape (n,)."""
        return self.probability > AUDIBLE_ABOVE


def audible_paths(level: Level, places: Array) -> AudiblePaths:
    """Find the path that is most probably reported from each position.

    Parameters
    ----------
    level : Level
        The station's finest level.
    places : ndarray of shape (n, 3), m
        In the table's frame.
    """
    order = np.argsort(places[:, 0], kind="stable")
    ordered = np.ascontiguousarray(places[order])
    found = _Found.nothing(len(places))
    solid_angle = np.repeat(level.grid.solid_angles, level.grid.ring_cells)
    log_mass = np.asarray(level.cell_log_mass, np.float64)
    for first, last in level.ranges(_CHUNK):
        begin, end = int(level.cell_offsets[first]), int(level.cell_offsets[last])
        cells = _Cells(
            first=first,
            offsets=np.asarray(level.cell_offsets[first : last + 1], np.int64) - begin,
            log_mass=log_mass,
            solid_angle=solid_angle,
        )
        _search(cells, _Components.of(level.mixture[begin:end]), ordered, found)
    back = np.argsort(order, kind="stable")
    return _as_paths(level, _Found._make(array[back] for array in found))


class _Cells(NamedTuple):
    """Cells of a level.

    Attributes
    ----------
    first : int
        Number of the first one.
    offsets : ndarray of int64, shape (n_cells + 1,)
        Components of each.
    log_mass, solid_angle : ndarray
        Of all cells of the level.
    """

    first: int
    offsets: NDArray[np.int64]
    log_mass: Array
    solid_angle: Array


class _Components(NamedTuple):
    """Components as Gaussians over the position, and their ray coordinates.

    Attributes
    ----------
    log_height : ndarray of shape (k,)
        Log density at the mean.
    mean, deviation : ndarray of shape (k, 3), m
    precision : ndarray of shape (k, 3, 3), 1 / m2
    u_mean : ndarray of shape (k, 3)
    u_cov, jacobian : ndarray of shape (k, 3, 3)
    """

    log_height: Array
    mean: Array
    deviation: Array
    precision: Array
    u_mean: Array
    u_cov: Array
    jacobian: Array

    @classmethod
    def of(cls, part: TubeMixture) -> "_Components":
        """Return the components of a mixture."""
        return cls(
            *_as_gaussians(part),
            np.asarray(part.u_mean, np.float64),
            unpack(np.asarray(part.u_cov, np.float64)),
            np.asarray(part.jacobian, np.float64),
        )


class _Found(NamedTuple):
    """The cell of the largest density at each position so far, which the search updates.

    Attributes
    ----------
    density : ndarray of shape (n,)
    cell : ndarray of int64, shape (n,)
        -1 where there is none.
    total : ndarray of shape (n,)
        Sum over all cells of the density times the solid angle.
    u, u_mean : ndarray of shape (n, 3)
        Ray coordinates of the position and mean of the cell's densest component there.
    jacobian : ndarray of shape (n, 3, 3)
        Of that component.
    """

    density: Array
    cell: NDArray[np.int64]
    total: Array
    u: Array
    u_mean: Array
    jacobian: Array

    @classmethod
    def nothing(cls, count: int) -> "_Found":
        """Return that nothing is known of so many positions."""
        return cls(
            np.zeros(count),
            np.full(count, -1, np.int64),
            np.zeros(count),
            np.zeros((count, 3)),
            np.zeros((count, 3)),
            np.zeros((count, 3, 3)),
        )


def _as_gaussians(part: TubeMixture) -> tuple[Array, Array, Array, Array]:
    """Components as Gaussians over the position: log density at the mean, mean, standard deviations, precision."""
    cov = joint_cov(part)[:, 3:, 3:] + _FLOOR**2 * np.eye(3)
    log_height = np.asarray(part.log_weight, np.float64) - 0.5 * np.linalg.slogdet(2.0 * np.pi * cov)[1]
    deviation = np.sqrt(np.einsum("nii->ni", cov))
    return log_height, np.asarray(part.x_mean, np.float64), deviation, np.asarray(np.linalg.inv(cov))


@numba.njit(cache=True, nogil=True)
def _search(cells: Any, components: Any, places: Any, found: Any) -> None:
    """Compute the density of each cell at the positions in its reach, and keep the largest in ``found``.

    Parameters
    ----------
    cells : _Cells
    components : _Components
    places : ndarray of shape (n, 3), m
        By ascending x.
    found : _Found
    """
    first, offsets, log_mass, solid_angle = cells
    log_height, mean, deviation, precision, u_mean, u_cov, jacobian = components
    best_density, best_cell, total, best_u, best_mean, best_jacobian = found
    count = len(places)
    density, densest, member = np.zeros(count), np.zeros(count), np.zeros(count, np.int64)
    touched = np.empty(count, np.int64)
    apart, turned = np.empty(3), np.empty(3)
    for c in range(len(offsets) - 1):
        num_touched = 0
        for k in range(offsets[c], offsets[c + 1]):
            begin = np.searchsorted(places[:, 0], mean[k, 0] - _REACH * deviation[k, 0])
            for n in range(begin, count):
                if places[n, 0] > mean[k, 0] + _REACH * deviation[k, 0]:
                    break
                if abs(places[n, 1] - mean[k, 1]) > _REACH * deviation[k, 1]:
                    continue
                if abs(places[n, 2] - mean[k, 2]) > _REACH * deviation[k, 2]:
                    continue
                square = 0.0
                for i in range(3):
                    for j in range(3):
                        square += (places[n, i] - mean[k, i]) * precision[k, i, j] * (places[n, j] - mean[k, j])
                if square > _REACH * _REACH:
                    continue
                here = np.exp(log_height[k] - 0.5 * square)
                if density[n] == 0.0:
                    touched[num_touched] = n
                    num_touched += 1
                density[n] += here
                if here > densest[n]:
                    densest[n] = here
                    member[n] = k
        for t in range(num_touched):
            n = touched[t]
            here = density[n] * np.exp(log_mass[first + c])
            total[n] += here * solid_angle[first + c]
            if here > best_density[n]:
                best_density[n] = here
                best_cell[n] = first + c
                k = member[n]
                # E[u | x] = u_mean + u_cov jacobian^T cov^-1 (x - x_mean)
                for i in range(3):
                    apart[i] = 0.0
                    for j in range(3):
                        apart[i] += precision[k, i, j] * (places[n, j] - mean[k, j])
                for i in range(3):
                    turned[i] = 0.0
                    for j in range(3):
                        turned[i] += jacobian[k, j, i] * apart[j]
                for i in range(3):
                    best_u[n, i] = u_mean[k, i]
                    best_mean[n, i] = u_mean[k, i]
                    for j in range(3):
                        best_u[n, i] += u_cov[k, i, j] * turned[j]
                        best_jacobian[n, i, j] = jacobian[k, i, j]
            density[n] = 0.0
            densest[n] = 0.0


def _as_paths(level: Level, best: _Found) -> AudiblePaths:
    """Turn tangent coordinates into angles, and tubes into gradients."""
    cell, u, u_mean, jacobian = best.cell, best.u, best.u_mean, best.jacobian
    found = cell >= 0
    centres = level.grid.centres[cell[found]]
    azimuth, zenith = _angles(u[found], centres)
    length = u[found, 0]
    predicted = {name: np.zeros(len(cell)) for name in ("azimuth", "zenith", "path_length")}
    predicted["azimuth"][found], predicted["zenith"][found], predicted["path_length"][found] = azimuth, zenith, length
    # The tube's axes are rotated: the reflections act in the same way on a neighbouring direction.
    mirror = _turn(u_mean[found, 0], jacobian[found]) @ _frame(*_angles(u_mean[found], centres)).transpose(0, 2, 1)
    turn = mirror @ _frame(azimuth, zenith)
    gradients = np.zeros((len(cell), 3, 3))
    gradients[found] = turn.transpose(0, 2, 1) / _scale(length)[:, :, None]
    return AudiblePaths(probability=best.total, gradients=gradients, **predicted)


def _angles(u: Array, centres: Array) -> tuple[Array, Array]:
    """Azimuth and zenith of tangent coordinates about centres of shape (n, 2)."""
    azimuth = wrap(centres[:, 0] + u[:, 1] / np.sin(centres[:, 1]))
    return azimuth, np.clip(centres[:, 1] + u[:, 2], 0.0, np.pi)


def _frame(azimuth: Array, zenith: Array) -> Array:
    """Return the unit vectors of the direction and of increasing azimuth and zenith, as columns, shape (n, 3, 3)."""
    across = direction(azimuth + 0.5 * np.pi, np.full_like(azimuth, 0.5 * np.pi))
    return np.stack([direction(azimuth, zenith), across, direction(azimuth, zenith + 0.5 * np.pi)], axis=-1)


def _turn(length: Array, jacobian: Array) -> Array:
    """Rotation, with reflections, from (length, angles) to the position; shape (n, 3, 3).

    For one reflection sequence, dx/du is an orthogonal matrix times diag(1, length, length). A component can have
    several; its jacobian is approximated by the nearest matrix of that form (the orthogonal Procrustes problem: P. H.
    Schoenemann, Psychometrika 31, 1966).
    """
    left, _, right = np.linalg.svd(jacobian / _scale(length)[:, None, :])
    return np.asarray(left @ right)


def _scale(length: Array) -> Array:
    return np.stack([np.ones_like(length), length, length], axis=-1)
