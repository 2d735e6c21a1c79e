"""Directions from covariances: Delay-and-Sum, MVDR, MUSIC and ESPRIT on a uniform planar array.

The estimators are implemented here because no maintained library has all of them for planar arrays: existing ones have
only linear arrays or signals of other fields.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.arrays.planar import Array, Complex, PlanarArray

_PER_BEAM = 8.0  # points of the search grid per beam width
_PRECISION = 1e-7  # step of the direction cosines at which a search ends
_MOST_STEPS = 300  # of a search, which could follow rounding errors on a flat maximum
_LOADING = 1e-6  # fraction of the mean power that is added to the diagonal, to make it invertible for MVDR


@dataclass(frozen=True, kw_only=True)
class Waves:
    """Estimated waves, strongest first.

    Attributes
    ----------
    cosines : ndarray of shape (n, 2)
        Direction cosines along the local y and z axis.
    power : ndarray of shape (n,)
        Received at one antenna.
    """

    cosines: Array
    power: Array

    def __len__(self) -> int:
        """Return the number of waves."""
        return len(self.power)


Estimator = Callable[[Complex, PlanarArray, int], Waves]
"""Takes a covariance, its array, and the largest number of waves to find."""


def delay_and_sum(cov: Complex, array: PlanarArray, count: int) -> Waves:
    """Find the peaks of a beam's power: a^H R a.

    Notes
    -----
    M. S. Bartlett, "Smoothing periodograms from time-series with continuous spectra", Nature 161 (1948).
    """
    form = _Form.of(cov, array)
    peaks = _peaks(form, array, count)
    return _sorted(peaks, form.at(peaks) / len(array) ** 2)


def mvdr(cov: Complex, array: PlanarArray, count: int) -> Waves:
    """Find the peaks of the minimum-variance spectrum 1 / (a^H R^-1 a).

    Notes
    -----
    J. Capon, "High-resolution frequency-wavenumber spectrum analysis", Proceedings of the IEEE 57 (1969).
    """
    loading = _LOADING * np.trace(cov).real / len(array)
    form = -_Form.of(np.asarray(np.linalg.inv(cov + loading * np.eye(len(array)))), array)
    peaks = _peaks(form, array, count)
    return _sorted(peaks, -1.0 / form.at(peaks))


def music(cov: Complex, array: PlanarArray, count: int) -> Waves:
    """Find the directions with the smallest projection onto the noise subspace.

    Notes
    -----
    R. O. Schmidt, "Multiple emitter location and signal parameter estimation", IEEE Transactions on Antennas and
    Propagation 34 (1986).
    """
    noise = np.linalg.eigh(cov)[1][:, : len(array) - count]
    form = -_Form.of(np.asarray(noise @ noise.conj().T), array)
    peaks = _peaks(form, array, count)
    return _sorted(peaks, wave_powers(cov, array, peaks))


def esprit(cov: Complex, array: PlanarArray, count: int) -> Waves:
    """Find directions from the rotation of the signal subspace between subarrays shifted by one column or one row.

    Notes
    -----
    R. Roy, T. Kailath, "ESPRIT: estimation of signal parameters via rotational invariance techniques", IEEE
    Transactions on Acoustics, Speech and Signal Processing 37 (1989). The rotations of both axes have the same
    eigenvectors, which pairs them, as in M. D. Zoltowski, M. Haardt, C. P. Mathews, IEEE Transactions on Signal
    Processing 44 (1996).
    """
    signals = np.linalg.eigh(cov)[1][:, len(array) - count :]
    grid = signals.reshape(array.columns, array.rows, count)
    turns = []
    for before, after in ((grid[:-1], grid[1:]), (grid[:, :-1], grid[:, 1:])):
        turns.append(np.linalg.lstsq(before.reshape(-1, count), after.reshape(-1, count), rcond=None)[0])
    # Any linear combination of the two has these eigenvectors; with an irrational factor, eigenvalues hardly coincide.
    vectors = np.linalg.eig(turns[0] + np.sqrt(0.5) * turns[1])[1]
    inverse = np.linalg.pinv(vectors)
    phases = [np.angle(np.einsum("ij,jk,ki->i", inverse, turn, vectors)) for turn in turns]
    cosines = np.stack(phases, axis=-1) / (2.0 * np.pi * array.spacing)
    # Noise can move direction cosines outside of the unit circle.
    cosines /= np.maximum(1.0, np.linalg.norm(cosines, axis=1, keepdims=True))
    return _sorted(cosines, wave_powers(cov, array, cosines))


ESTIMATORS: dict[str, Estimator] = {
    "Delay-and-Sum": delay_and_sum,
    "MVDR": mvdr,
    "MUSIC": music,
    "ESPRIT": esprit,
}
"""Estimators by name in tables and figures."""


def wave_powers(cov: Complex, array: PlanarArray, cosines: Array) -> Array:
    """Powers of waves from given directions, by least squares, shape (n,).

    The noise power, the mean of the remaining eigenvalues, is subtracted.
    """
    noise = np.linalg.eigvalsh(cov)[: max(1, len(array) - len(cosines))].mean()
    fitted = np.linalg.pinv(array.steering(cosines))
    cleared = cov - noise * np.eye(len(array))
    return np.asarray(np.maximum(np.einsum("km,km->k", fitted @ cleared, fitted.conj()).real, 0.0))


def _sorted(cosines: Array, power: Array) -> Waves:
    order = np.argsort(-power, kind="stable")
    return Waves(cosines=cosines[order], power=power[order])


@dataclass(frozen=True, kw_only=True)
class _Form:
    """A quadratic form a^H Q a of the steering vectors: a sum over the steps between antennas.

    Attributes
    ----------
    sums : ndarray of complex of shape (2 columns - 1, 2 rows - 1)
        Sums of the entries of Q over all pairs of antennas with the same offset in columns and rows.
    spacing : float
    """

    sums: Complex
    spacing: float

    @classmethod
    def of(cls, matrix: Complex, array: PlanarArray) -> "_Form":
        shape = (2 * array.columns - 1, 2 * array.rows - 1)
        column, row = np.indices((array.columns, array.rows)).reshape(2, -1)
        step = (column - column[:, None] + array.columns - 1) * shape[1] + (row - row[:, None] + array.rows - 1)
        real, imag = (
            np.bincount(step.ravel(), part.ravel(), shape[0] * shape[1]) for part in (matrix.real, matrix.imag)
        )
        return cls(sums=(real + 1j * imag).reshape(shape), spacing=array.spacing)

    def __neg__(self) -> "_Form":
        return _Form(sums=-self.sums, spacing=self.spacing)

    def at(self, cosines: Array) -> Array:
        """Values at direction cosines of shape (n, 2), shape (n,)."""
        along, across = (self._phases(cosines[:, axis], axis) for axis in range(2))
        return np.asarray(np.einsum("np,np->n", along @ self.sums, across).real)

    def on_grid(self, along: Array, across: Array) -> Array:
        """Values at all pairs of cosines along y and along z, shape (n, m)."""
        return np.asarray((self._phases(along, 0) @ self.sums @ self._phases(across, 1).T).real)

    def _phases(self, cosine: Array, axis: int) -> Complex:
        reach = self.sums.shape[axis] // 2
        return np.asarray(np.exp(2j * np.pi * self.spacing * np.outer(cosine, np.arange(-reach, reach + 1))))


def _peaks(form: _Form, array: PlanarArray, count: int) -> Array:
    """Highest local maxima of a form over the half sphere, highest first, shape (n, 2); at least one."""
    steps = [max(8, int(np.ceil(2.0 * _PER_BEAM * array.spacing * size))) for size in (array.columns, array.rows)]
    along, across = (np.linspace(-1.0, 1.0, n + 1) for n in steps)
    inside = np.square(along)[:, None] + np.square(across) < 1.0
    values = np.where(inside, form.on_grid(along, across), -np.inf)
    first, second = np.nonzero(_local_maxima(values))
    best = np.argsort(-values[first, second], kind="stable")[:count]
    starts = np.stack([along[first[best]], across[second[best]]], axis=-1)
    return _climb(form, starts, max(2.0 / n for n in steps))


def _local_maxima(values: Array) -> NDArray[np.bool_]:
    """Points of a grid that are at least as high as their eight neighbours."""
    padded = np.pad(values, 1, constant_values=-np.inf)
    highest = np.isfinite(values)
    for i in range(3):
        for j in range(3):
            if (i, j) != (1, 1):
                highest &= values >= padded[i : i + values.shape[0], j : j + values.shape[1]]
    return highest


def _climb(form: _Form, starts: Array, step: float) -> Array:
    """Climb from starts of shape (n, 2) to the nearest peaks, by decreasing steps on a pattern of nine points."""
    offsets = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 2)
    points = starts.copy()
    widths = np.full(len(points), step)
    for _ in range(_MOST_STEPS):
        if (widths <= _PRECISION).all():
            break
        around = points[:, None] + widths[:, None, None] * offsets
        length = np.linalg.norm(around, axis=-1, keepdims=True)
        around = np.where(length < 1.0, around, around / np.maximum(length, 1.0))
        values = form.at(around.reshape(-1, 2)).reshape(len(points), -1)
        best = np.argmax(values, axis=1)
        row = np.arange(len(points))
        # On the rim several of the nine points coincide: only a higher value than in the middle counts as a step.
        higher = values[row, best] > values[:, 4]
        points = np.where(higher[:, None], around[row, best], points)
        widths = np.where(higher, widths, 0.5 * widths)
    return points
