"""A sphere's polarisability, and the coupling of the tests' bodies, against closed forms."""

import cmath
import math

import numpy as np
import pytest
from metal_world import induced_moments

from anser_ros.metal.body import SMALL, sphere_polarisability
from anser_ros.physics.constants import MU_0

RADIUS = 0.02


def polarisability(radius, conductivity, permeability, frequency):
    """Return the sphere's polarisability at one frequency, m^3."""
    omega = np.array([2 * math.pi * frequency])
    return MU_0 * sphere_polarisability(radius, conductivity, permeability, omega)[0]


def test_static_permeable_sphere():
    """4 pi a^3 (mu_r - 1)/(mu_r + 2), Jackson section 5.11."""
    for permeability in (1.0, 2.0, 1000.0):
        alpha = polarisability(RADIUS, 0.0, permeability, 0.0)
        expected = 4 * math.pi * RADIUS**3 * (permeability - 1) / (permeability + 2)
        assert alpha == pytest.approx(expected, abs=1e-18)


def test_perfect_conductor():
    alpha = polarisability(RADIUS, 5.8e7, 1.0, 1e9)
    assert alpha == pytest.approx(-2 * math.pi * RADIUS**3, rel=1e-3)


def test_weak_conductor_is_the_first_order_of_its_eddy_currents():
    """m = -j w mu0 sigma 2 pi a^5 B / (15 mu0): Landau and Lifshitz, section 59."""
    conductivity, frequency = 1e3, 1e3
    alpha = polarisability(RADIUS, conductivity, 1.0, frequency)
    omega = 2 * math.pi * frequency
    expected = -2j * math.pi * RADIUS**5 * omega * MU_0 * conductivity / 15
    assert alpha == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize('frequency', [1.0, 1e2, 1e3, 1e4, 1e6])
def test_conductor_against_the_bessel_series(frequency):
    """alpha = -2 pi a^3 (1 + 3/x^2 - 3 coth(x)/x) for mu_r = 1 (Landau and Lifshitz, 59.4)."""
    x = RADIUS * cmath.sqrt(2j * math.pi * frequency * MU_0 * 3.5e7)
    coth = cmath.cosh(x) / cmath.sinh(x) if x.real < 300 else 1.0
    expected = -2 * math.pi * RADIUS**3 * (1 + 3 / x**2 - 3 * coth / x)
    alpha = polarisability(RADIUS, 3.5e7, 1.0, frequency)
    assert alpha == pytest.approx(expected, rel=1e-6)
    assert alpha.real < 0
    assert alpha.imag < 0, 'an induced moment lags'


def test_the_series_and_the_closed_form_meet():
    edge = (SMALL / RADIUS) ** 2 / MU_0
    below, above = sphere_polarisability(RADIUS, 1.0, 1.0, edge * np.array([0.99999, 1.00001]))
    assert above == pytest.approx(below, rel=5e-5)


@pytest.mark.parametrize('arguments', [(0.0, 1.0, 1.0, 1.0), (1.0, 1.0, 0.0, 1.0),
                                       (1.0, -1.0, 1.0, 1.0), (1.0, 1.0, 1.0, -1.0)])  # fmt: skip
def test_impossible_spheres_are_refused(arguments):
    with pytest.raises(ValueError, match='must'):
        polarisability(*arguments)


def test_coupled_pair_along_the_line_that_joins_them():
    """Two spheres in an axial field: alpha_eff = alpha / (1 - alpha / (2 pi d^3))."""
    distance = 0.05
    positions = np.array([[0, 0, 0], [0, 0, distance]])
    alpha = 4 * math.pi * RADIUS**3
    field = np.tile([0.0, 0.0, 1e-6], (2, 1, 1))
    moments = induced_moments(positions, np.full(2, alpha / MU_0), field)
    expected = alpha / (1 - alpha / (2 * math.pi * distance**3)) * 1e-6 / MU_0
    np.testing.assert_allclose(moments[:, 0, 2], expected, rtol=1e-12)
