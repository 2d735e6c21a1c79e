"""Reflection by building materials: permittivities of ITU-R P.2040-3 and Fresnel's coefficients.

A wall of unknown thickness is modelled as a half space: reflections from its far side are neglected; for slabs see
:mod:`~rayfix_offline.scene.slabs`. The power is averaged over both polarisations, because the orientation of the
transmitter's antenna is not known.
"""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

VACUUM_PERMITTIVITY = 8.8541878128e-12
"""F/m."""


@dataclass(frozen=True, kw_only=True)
class ReflectionSettings:
    """Settings of reflections; part of the identity of every station's part of a table.

    Attributes
    ----------
    min_power : float
        A reflection leaves at least this fraction of the power, so that logarithms are finite.
    grazing_cosine : float
        Below this cosine of the angle of incidence, any material reflects all of the power.
    """

    min_power: float = 1e-12
    grazing_cosine: float = 1e-12


@dataclass(frozen=True, kw_only=True)
class ItuParameters:
    """A row of table 3 of ITU-R P.2040-3, for the frequency f in GHz.

    Attributes
    ----------
    lowest_ghz, highest_ghz : float
        Frequency range of the row.
    a, b : float
        Real part of the relative permittivity: ``a f^b``.
    c, d : float
        Conductivity: ``c f^d``, S/m.
    """

    lowest_ghz: float
    highest_ghz: float
    a: float
    b: float
    c: float
    d: float


def _rows(*rows: tuple[float, float, float, float, float, float]) -> tuple[ItuParameters, ...]:
    return tuple(ItuParameters(lowest_ghz=low, highest_ghz=high, a=a, b=b, c=c, d=d) for low, high, a, b, c, d in rows)


ITU_MATERIALS = {
    "vacuum": _rows((0.001, 100.0, 1.0, 0.0, 0.0, 0.0)),
    "concrete": _rows((1.0, 100.0, 5.24, 0.0, 0.0462, 0.7822)),
    "brick": _rows((1.0, 40.0, 3.91, 0.0, 0.0238, 0.16)),
    "plasterboard": _rows((1.0, 100.0, 2.73, 0.0, 0.0085, 0.9395)),
    "wood": _rows((0.001, 100.0, 1.99, 0.0, 0.0047, 1.0718)),
    "glass": _rows((0.1, 100.0, 6.31, 0.0, 0.0036, 1.3394), (220.0, 450.0, 5.79, 0.0, 0.0004, 1.658)),
    "ceiling_board": _rows((1.0, 100.0, 1.48, 0.0, 0.0011, 1.0750), (220.0, 450.0, 1.52, 0.0, 0.0029, 1.029)),
    "chipboard": _rows((1.0, 100.0, 2.58, 0.0, 0.0217, 0.78)),
    "plywood": _rows((1.0, 40.0, 2.71, 0.0, 0.33, 0.0)),
    "marble": _rows((1.0, 60.0, 7.074, 0.0, 0.0055, 0.9262)),
    "floorboard": _rows((50.0, 100.0, 3.66, 0.0, 0.0044, 1.3515)),
    "metal": _rows((1.0, 100.0, 1.0, 0.0, 1e7, 0.0)),
    "very_dry_ground": _rows((1.0, 10.0, 3.0, 0.0, 0.00015, 2.52)),
    "medium_dry_ground": _rows((1.0, 10.0, 15.0, -0.1, 0.035, 1.63)),
    "wet_ground": _rows((1.0, 10.0, 30.0, -0.4, 0.15, 1.30)),
}
"""Table 3 of ITU-R P.2040-3."""


def face_permittivity(
    face_materials: NDArray[np.int16], materials: tuple[str, ...], carrier_ghz: float
) -> NDArray[np.complex128]:
    """Complex relative permittivity of each triangle, shape (n_faces,); NaN where it is not known."""
    found = [complex_permittivity(name, carrier_ghz) for name in materials]
    # The last entry is that of index -1.
    table = np.array([np.nan if value is None else value for value in found] + [np.nan], np.complex128)
    return np.asarray(table[face_materials])


def itu_name(name: str) -> str | None:
    """Name of a material in :data:`ITU_MATERIALS`, from what a mesh calls it; None for any other.

    Sionna RT and Blender's Mitsuba exporter write ``itu_concrete``, ``itu-concrete`` or ``mat-itu_concrete``; Blender
    numbers copies, as in ``itu_concrete.001``.
    """
    plain = plain_name(name)
    return plain if plain in ITU_MATERIALS else None


def plain_name(name: str) -> str:
    """Name of a material without the prefixes and numbers of copies that exporters add; see :func:`itu_name`."""
    plain = re.sub(r"\.\d+$", "", name.strip().lower())
    plain = re.sub(r"[-_\s]+", "_", plain)
    return plain.removeprefix("mat_").removeprefix("itu_")


def complex_permittivity(name: str, carrier_ghz: float) -> complex | None:
    """Complex relative permittivity of a material (ITU-R P.2040-3, section 2.1.4).

    Parameters
    ----------
    name : str
        Name in a mesh; see :func:`itu_name`.
    carrier_ghz : float

    Returns
    -------
    complex or None
        ``a f^b - j c f^d / (2 pi f eps0)``; None for a material or a frequency that is not in the table.
    """
    plain = itu_name(name)
    for row in ITU_MATERIALS[plain] if plain else ():
        if row.lowest_ghz <= carrier_ghz <= row.highest_ghz:
            return with_conductivity(row.a * carrier_ghz**row.b, row.c * carrier_ghz**row.d, carrier_ghz)
    return None


def with_conductivity(permittivity: float, conductivity: float, carrier_ghz: float) -> complex:
    """Complex relative permittivity of a real one and a conductivity in S/m."""
    return complex(permittivity, -conductivity / (2.0 * np.pi * carrier_ghz * 1e9 * VACUUM_PERMITTIVITY))


def fresnel_power(
    cos_incidence: ArrayLike, permittivity: ArrayLike, *, grazing_cosine: float = ReflectionSettings.grazing_cosine
) -> NDArray[np.float64]:
    """Fraction of the power that a half space reflects, the mean of both polarisations.

    With the coefficients r_TE and r_TM of ITU-R P.2040-3 for a single interface and a wave that comes from air.

    Parameters
    ----------
    cos_incidence : ndarray
        Cosine of the angle between ray and normal, in [0, 1].
    permittivity : ndarray of complex
        Complex relative permittivity; arrays broadcast.
    grazing_cosine : float
        Below this cosine, all of the power is reflected.

    Returns
    -------
    ndarray
        In [0, 1].
    """
    te, tm = fresnel_coefficients(cos_incidence, permittivity, grazing_cosine=grazing_cosine)
    return np.asarray(np.minimum(0.5 * (np.abs(te) ** 2 + np.abs(tm) ** 2), 1.0))


def fresnel_coefficients(
    cos_incidence: ArrayLike, permittivity: ArrayLike, *, grazing_cosine: float = ReflectionSettings.grazing_cosine
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Reflection coefficients of the electric field, transverse electric and transverse magnetic.

    See :func:`fresnel_power`; any material reflects all of a grazing ray, at a cosine below ``grazing_cosine``.
    """
    cos, eps = np.broadcast_arrays(
        np.clip(np.asarray(cos_incidence, np.float64), 0.0, 1.0), np.asarray(permittivity, np.complex128)
    )
    # eps - sin^2, without the cancellation of 1 - sin^2 at grazing incidence.
    root = np.sqrt(eps - 1.0 + cos**2)
    grazing = cos < grazing_cosine
    te = np.where(grazing, -1.0, (cos - root) / np.where(grazing, 1.0, cos + root))
    tm = np.where(grazing, -1.0, (eps * cos - root) / np.where(grazing, 1.0, eps * cos + root))
    return te, tm
