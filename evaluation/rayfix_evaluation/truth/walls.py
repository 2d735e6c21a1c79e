"""What the walls of the forward solver are made of: reflection, transmission and length of each triangle."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rayfix_evaluation.truth.fresnel import excess_length, half_space, slab

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True, eq=False)
class Walls:
    """Materials of the faces of a mesh.

    A face lets signals through if it has a finite ``transmission_loss_db``, or if that is NaN and permittivity and
    thickness are known.

    Attributes
    ----------
    permittivity : ndarray of complex of shape (n_faces,)
        Complex relative permittivity; NaN where constant losses apply.
    thickness : ndarray of shape (n_faces,), m
        Thickness of the sheet; NaN where it is not known. A face with a permittivity and no thickness reflects as a
        half space. The value of a solid's face only says that it lets signals through: its slab is as thick as the
        solid is at the place.
    reflection_loss_db : ndarray of shape (n_faces,), dB
        Constant loss of a bounce; NaN where permittivity and thickness tell it.
    transmission_loss_db : ndarray of shape (n_faces,), dB
        Constant loss of a passage; NaN where permittivity and thickness tell it, infinite where nothing passes.
    solid : ndarray of int of shape (n_faces,)
        Closed part of the mesh to which the face belongs; -1 for a sheet.
    carrier_ghz : float
        Carrier frequency.
    excess_length : bool
        Whether slabs lengthen the paths that pass through them.

    Raises
    ------
    ValueError
        If the arrays differ in length, or a value is out of range.
    """

    permittivity: ComplexArray
    thickness: Array
    reflection_loss_db: Array
    transmission_loss_db: Array
    solid: NDArray[np.int32]
    carrier_ghz: float
    excess_length: bool = True

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together."""
        shapes = {name: np.shape(getattr(self, name)) for name in self._arrays()}
        if len(set(shapes.values())) != 1 or len(next(iter(shapes.values()))) != 1:
            told = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise ValueError(f"the walls' arrays have the shapes {told}; they must have one value for each face")
        if not (np.isfinite(self.carrier_ghz) and self.carrier_ghz > 0.0):
            raise ValueError(f"carrier_ghz is {self.carrier_ghz}; it must be positive and finite")
        for name in ("thickness", "reflection_loss_db", "transmission_loss_db"):
            if (getattr(self, name) < 0.0).any():
                raise ValueError(f"{name} has negative values; give metres and decibels from 0 on, or NaN")

    @classmethod
    def opaque(cls, permittivity: ComplexArray, *, carrier_ghz: float) -> "Walls":
        """Return walls that reflect as half spaces and let nothing through; NaN for the solver's constant loss."""
        unknown = np.full(np.shape(permittivity), np.nan)
        return cls(
            permittivity=np.asarray(permittivity, np.complex128),
            thickness=unknown,
            reflection_loss_db=unknown,
            transmission_loss_db=np.full_like(unknown, np.inf),
            solid=np.full(np.shape(permittivity), -1, np.int32),
            carrier_ghz=carrier_ghz,
        )

    @classmethod
    def sheets(cls, permittivity: ComplexArray, thickness: Array, *, carrier_ghz: float) -> "Walls":
        """Return sheets that let signals through wherever permittivity and thickness are known."""
        unknown = np.full(np.shape(permittivity), np.nan)
        return cls(
            permittivity=np.asarray(permittivity, np.complex128),
            thickness=np.asarray(thickness, np.float64),
            reflection_loss_db=unknown,
            transmission_loss_db=unknown,
            solid=np.full(np.shape(permittivity), -1, np.int32),
            carrier_ghz=carrier_ghz,
        )

    def __len__(self) -> int:
        """Return the number of faces."""
        return len(self.permittivity)

    def of_faces(self, faces: NDArray[np.int64]) -> "Walls":
        """Select faces, in the order of their indices."""
        chosen = {name: np.ascontiguousarray(getattr(self, name)[faces]) for name in self._arrays()}
        return Walls(**chosen, carrier_ghz=self.carrier_ghz, excess_length=self.excess_length)

    @property
    def lets_through(self) -> NDArray[np.bool_]:
        """Whether signals pass through each face, shape (n_faces,)."""
        known = np.isfinite(self.permittivity) & np.isfinite(self.thickness)
        return np.isfinite(self.transmission_loss_db) | (np.isnan(self.transmission_loss_db) & known)

    def reflection(
        self, faces: NDArray[np.int64], cos_incidence: Array, thickness: Array, *, constant_loss_db: float
    ) -> ComplexArray:
        """Reflection coefficients of bounces, as :func:`half_space` counts them.

        Parameters
        ----------
        faces : ndarray of int of shape (n,)
        cos_incidence : ndarray of shape (n,)
        thickness : ndarray of shape (n,), m
            Thickness of the slab at the place of the bounce; NaN for a half space.
        constant_loss_db : float
            Loss where neither a loss nor a permittivity is known.

        Returns
        -------
        ndarray of complex of shape (n, 2)
        """
        permittivity, loss = self.permittivity[faces], self.reflection_loss_db[faces]
        by_formula = np.isnan(loss) & np.isfinite(permittivity)
        out: ComplexArray = _constant(np.where(np.isnan(loss), constant_loss_db, loss)) * np.array([-1.0, 1.0])
        thick = by_formula & ~np.isfinite(thickness)
        thin = by_formula & np.isfinite(thickness)
        out[thick] = half_space(cos_incidence[thick], permittivity[thick])
        out[thin] = slab(cos_incidence[thin], permittivity[thin], thickness[thin], self.carrier_ghz)[0]
        return out

    def transmission(self, faces: NDArray[np.int64], cos_incidence: Array, thickness: Array) -> ComplexArray:
        """Transmission coefficients of passages; see :meth:`reflection`."""
        permittivity, loss = self.permittivity[faces], self.transmission_loss_db[faces]
        out = _constant(np.where(np.isnan(loss), 0.0, loss))
        by_formula = np.isnan(loss)
        out[by_formula] = slab(
            cos_incidence[by_formula], permittivity[by_formula], thickness[by_formula], self.carrier_ghz
        )[1]
        return out

    def excess(self, faces: NDArray[np.int64], cos_incidence: Array, thickness: Array) -> Array:
        """Length that passages add to a path, shape (n,), m: 0 where thickness or permittivity is not known."""
        out = np.zeros(len(faces))
        permittivity = self.permittivity[faces]
        known = np.isfinite(permittivity) & np.isfinite(thickness)
        if self.excess_length and known.any():
            out[known] = excess_length(cos_incidence[known], permittivity[known], thickness[known])
        return out

    @staticmethod
    def _arrays() -> list[str]:
        return [field.name for field in fields(Walls) if field.name not in ("carrier_ghz", "excess_length")]


def _constant(loss_db: Array) -> ComplexArray:
    """Coefficients of constant losses, equal for both polarisations, shape (n, 2)."""
    amplitude = 10.0 ** (-loss_db / 20.0)
    return np.stack([amplitude, amplitude], axis=1).astype(np.complex128)
