"""What the forward solver's walls reflect and let through, by Snell and Fresnel in the refractive index.

It shares no code with the ray launcher, which uses the formulas of ITU-R P.2040. A slab is the sum of the waves that
run to and fro in it (the etalon of Fabry and Perot). Time runs as ``exp(+j omega t)``: losses are a negative imaginary
part.
"""

import numpy as np
from numpy.typing import NDArray

from rayfix_service.measuring.ranging import SPEED_OF_LIGHT

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FLOOR_DB = -120.0
"""Smallest gain of a bounce, dB, to keep gains finite."""


def half_space(cos_incidence: Array, permittivity: ComplexArray) -> ComplexArray:
    """Reflection coefficients of half spaces.

    Parameters
    ----------
    cos_incidence : ndarray of shape (n,)
        Cosine of the angle between the ray and the mirror's normal, above 0.
    permittivity : ndarray of complex of shape (n,)
        Complex relative permittivity.

    Returns
    -------
    ndarray of complex of shape (n, 2)
        Of the electric field, perpendicular and parallel to the plane of incidence. The parallel field is counted along
        the direction of the ray times the perpendicular one, before and after the bounce.
    """
    index = np.sqrt(permittivity)
    cos_refraction = _cos_refraction(cos_incidence, index)
    perpendicular = (cos_incidence - index * cos_refraction) / (cos_incidence + index * cos_refraction)
    parallel = (index * cos_incidence - cos_refraction) / (index * cos_incidence + cos_refraction)
    return np.stack([perpendicular, parallel], axis=1)


def slab(
    cos_incidence: Array, permittivity: ComplexArray, thickness: Array, carrier_ghz: float
) -> tuple[ComplexArray, ComplexArray]:
    """Reflection and transmission coefficients of slabs in air.

    Parameters
    ----------
    cos_incidence : ndarray of shape (n,)
    permittivity : ndarray of complex of shape (n,)
    thickness : ndarray of shape (n,), m
    carrier_ghz : float

    Returns
    -------
    reflection, transmission : ndarray of complex of shape (n, 2)
        As in :func:`half_space`.
    """
    index = np.sqrt(permittivity)
    cos_refraction = _cos_refraction(cos_incidence, index)
    wave_number = 2.0 * np.pi * carrier_ghz * 1e9 / SPEED_OF_LIGHT
    # What one passage does to the wave inside.
    passage = np.exp(-1j * wave_number * thickness * index * cos_refraction)[:, None]
    outside = half_space(cos_incidence, permittivity)
    inside = -outside
    # The product of entering and leaving (Stokes): 1 - r^2. Each echo inside multiplies by the square of both.
    through = 1.0 - outside**2
    echo = (inside * passage) ** 2
    return outside + through * inside * passage**2 / (1.0 - echo), through * passage / (1.0 - echo)


def excess_length(cos_incidence: Array, permittivity: ComplexArray, thickness: Array) -> Array:
    """Optical length of slabs beyond that of the air that they replace, shape (n,), m.

    Parameters
    ----------
    cos_incidence : ndarray of shape (n,)
    permittivity : ndarray of complex of shape (n,)
        Its real part counts.
    thickness : ndarray of shape (n,), m
    """
    # The path in the slab is d / cos_refraction long, and index times that counts; the exit lies
    # d (tan_incidence - tan_refraction) sin_incidence nearer along the ray than without the slab.
    index = np.sqrt(np.maximum(permittivity.real, 1.0))
    sine = np.sqrt(np.maximum(1.0 - cos_incidence**2, 0.0))
    cos_refraction = np.sqrt(1.0 - (sine / index) ** 2)
    return np.asarray(thickness * (index * cos_refraction - cos_incidence))


def _cos_refraction(cos_incidence: Array, index: ComplexArray) -> ComplexArray:
    """Cosine of the complex angle of refraction, with waves that decay inside."""
    sin_refraction = np.sqrt(np.maximum(1.0 - cos_incidence**2, 0.0)) / index
    return np.asarray(np.sqrt(1.0 - sin_refraction**2))
