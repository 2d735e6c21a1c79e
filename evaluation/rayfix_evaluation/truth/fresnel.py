"""Reflectivity of the forward solver's mirrors, by Snell's law and Fresnel's equations in the refractive index.

It shares no code with the ray launcher, which uses the formulas of ITU-R P.2040.
"""

import numpy as np
from numpy.typing import NDArray

FLOOR_DB = -120.0
"""Smallest gain of a bounce, dB, to keep gains finite."""


def reflection_gain_db(cos_incidence: NDArray[np.float64], permittivity: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Fraction of the power that half spaces reflect, the mean of both polarisations.

    Parameters
    ----------
    cos_incidence : ndarray of shape (n,)
        Cosine of the angle between the ray and the mirror's normal, above 0.
    permittivity : ndarray of complex of shape (n,)
        Complex relative permittivity.

    Returns
    -------
    ndarray of shape (n,), dB
        At most 0.
    """
    index = np.sqrt(permittivity)
    sin_refraction = np.sqrt(1.0 - cos_incidence**2) / index
    cos_refraction = np.sqrt(1.0 - sin_refraction**2)
    perpendicular = (cos_incidence - index * cos_refraction) / (cos_incidence + index * cos_refraction)
    parallel = (index * cos_incidence - cos_refraction) / (index * cos_incidence + cos_refraction)
    power = (np.abs(perpendicular) ** 2 + np.abs(parallel) ** 2) / 2.0
    return np.asarray(10.0 * np.log10(np.clip(power, 10.0 ** (FLOOR_DB / 10.0), 1.0)))
