"""Walls as slabs: what they reflect, what they let through, and what they add to a path's length.

Section 2.2.2.2 of ITU-R P.2040-3, single layer: all reflections within the slab are summed. The power is averaged over
both polarisations, because the orientation of the transmitter's antenna is not known.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rayfix_offline.scene.materials import ReflectionSettings, fresnel_coefficients

SPEED_OF_LIGHT_GHZ = 0.299792458
"""m GHz: divided by a frequency it gives the wavelength."""


def slab_power(
    cos_incidence: ArrayLike,
    permittivity: ArrayLike,
    thickness: ArrayLike,
    *,
    carrier_ghz: float,
    grazing_cosine: float = ReflectionSettings.grazing_cosine,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fractions of the power that a slab in air reflects and lets through, means of both polarisations.

    Parameters
    ----------
    cos_incidence : ndarray
        Cosine of the angle between ray and normal, in [0, 1].
    permittivity : ndarray of complex
        Complex relative permittivity; arrays broadcast.
    thickness : ndarray, m
    carrier_ghz : float
    grazing_cosine : float
        Below this cosine, all of the power is reflected.

    Returns
    -------
    reflected, transmitted : ndarray
        In [0, 1].
    """
    cos, eps, width = np.broadcast_arrays(
        np.clip(np.asarray(cos_incidence, np.float64), 0.0, 1.0),
        np.asarray(permittivity, np.complex128),
        np.asarray(thickness, np.float64),
    )
    grazing = cos < grazing_cosine
    phase = np.exp(-2j * np.pi * width * carrier_ghz / SPEED_OF_LIGHT_GHZ * np.sqrt(eps - 1.0 + cos**2))
    reflected, transmitted = np.zeros(cos.shape), np.zeros(cos.shape)
    for interface in fresnel_coefficients(cos, eps, grazing_cosine=grazing_cosine):
        # One at grazing incidence, where the sums are 0 / 0 for some thicknesses.
        sums = np.where(grazing, 1.0, 1.0 - (interface * phase) ** 2)
        reflected += 0.5 * np.abs(interface * (1.0 - phase**2) / sums) ** 2
        transmitted += 0.5 * np.abs((1.0 - interface**2) * phase / sums) ** 2
    return (
        np.asarray(np.where(grazing, 1.0, np.minimum(reflected, 1.0))),
        np.asarray(np.where(grazing, 0.0, np.minimum(transmitted, 1.0))),
    )


def excess_length(cos_incidence: ArrayLike, permittivity: ArrayLike, thickness: ArrayLike) -> NDArray[np.float64]:
    """Length that a slab adds to the path of a signal that passes it, m.

    The phase of a slab that replaces as much air: ``d (sqrt(Re eps - sin^2 t) - cos t)`` at the angle of incidence t.
    """
    cos = np.clip(np.asarray(cos_incidence, np.float64), 0.0, 1.0)
    root = np.sqrt(np.maximum(np.real(permittivity) - 1.0, 0.0) + cos**2)
    return np.asarray(np.asarray(thickness) * np.maximum(root - cos, 0.0))
