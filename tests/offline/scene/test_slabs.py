"""Slabs against the matrices of stratified media (Born and Wolf), energy, and limits that have a closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rayfix_offline.scene.materials import complex_permittivity, fresnel_power
from rayfix_offline.scene.slabs import excess_length, slab_power

CARRIER = 3.5
WAVELENGTH = 0.299792458 / CARRIER

cosines = st.floats(0.01, 1.0)
thicknesses = st.floats(1e-3, 0.5)


def by_matrices(cos: float, eps: complex, thickness: float) -> tuple[float, float]:
    """Reflected and transmitted power: Maxwell's equations from one face of the layer to the other."""
    reflected, transmitted = [], []
    wave = 2 * np.pi / WAVELENGTH
    inner = np.sqrt(eps - (1 - cos**2))  # times wave: the component along the normal within the layer
    phase = wave * thickness * inner
    for admittance, outer in ((inner, cos), (eps / inner, 1 / cos)):
        matrix = np.array(
            [[np.cos(phase), 1j * np.sin(phase) / admittance], [1j * admittance * np.sin(phase), np.cos(phase)]]
        )
        electric, magnetic = matrix @ [1.0, outer]
        incident = 0.5 * (electric + magnetic / outer)
        reflected.append(abs(0.5 * (electric - magnetic / outer) / incident) ** 2)
        transmitted.append(abs(1.0 / incident) ** 2)
    return float(np.mean(reflected)), float(np.mean(transmitted))


@given(cos=cosines, real=st.floats(1.0, 10.0), imag=st.floats(0.0, 1.0), thickness=thicknesses)
def test_the_matrices_of_stratified_media(cos: float, real: float, imag: float, thickness: float) -> None:
    eps = complex(real, -imag)
    np.testing.assert_allclose(
        slab_power(cos, eps, thickness, carrier_ghz=CARRIER), by_matrices(cos, eps, thickness), rtol=1e-6, atol=1e-9
    )


@given(cos=st.floats(0.0, 1.0), real=st.floats(1.0, 100.0), imag=st.floats(0.0, 1e8), thickness=thicknesses)
def test_no_power_is_made(cos: float, real: float, imag: float, thickness: float) -> None:
    reflected, transmitted = slab_power(cos, complex(real, -imag), thickness, carrier_ghz=CARRIER)
    assert 0.0 <= reflected <= 1.0
    assert 0.0 <= transmitted <= 1.0
    assert reflected + transmitted <= 1.0 + 1e-9
    if imag == 0.0:
        assert reflected + transmitted == pytest.approx(1.0, abs=1e-9)


def test_half_a_wavelength_of_glass_is_not_seen() -> None:
    reflected, transmitted = slab_power(1.0, 6.25, WAVELENGTH / 2 / 2.5, carrier_ghz=CARRIER)
    assert reflected == pytest.approx(0.0, abs=1e-12)
    assert transmitted == pytest.approx(1.0, abs=1e-12)


def test_a_thick_lossy_wall_is_a_half_space() -> None:
    eps = 5.24 - 2j
    reflected, transmitted = slab_power(0.6, eps, 5.0, carrier_ghz=CARRIER)
    assert reflected == pytest.approx(float(fresnel_power(0.6, eps)), rel=1e-9)
    assert transmitted < 1e-12


@given(cos=st.floats(0.0, 1.0), real=st.floats(1.0, 10.0), imag=st.floats(0.0, 1.0), thickness=thicknesses)
def test_a_slab_makes_a_path_longer_by_its_phase(cos: float, real: float, imag: float, thickness: float) -> None:
    """At normal incidence by its index of refraction less 1; at grazing incidence by the way along the normal."""
    excess = excess_length(cos, complex(real, -imag), thickness)
    assert 0.0 <= excess <= thickness * np.sqrt(real)
    assert excess_length(1.0, real, thickness) == pytest.approx(thickness * (np.sqrt(real) - 1), abs=1e-12)


def test_concrete_delays_by_about_its_thickness() -> None:
    assert excess_length(1.0, complex_permittivity("concrete", CARRIER), 0.2) == pytest.approx(0.2578, abs=1e-4)
