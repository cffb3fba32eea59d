"""Computes the magnetic polarisability of a conducting permeable sphere in an alternating field.

Time convention exp(+j w t): a conductor's induced moment opposes the field, and lags by at most a
quarter period.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.constants import MU_0

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SMALL = 1e-2
"""|x| below which the series of q in x^2 is used, with an error under x^4 / 175; the closed form
loses as many digits as x^2 has zeros."""


def sphere_polarisability(
    radius_m: float, conductivity_s_per_m: float, relative_permeability: float, omega: Array
) -> ComplexArray:
    """Return the magnetic moment of a sphere per tesla of a uniform field exp(+j w t).

    The vector potential inside is that of the modified spherical Bessel function ``i1(x r / a)``
    with ``x = a sqrt(j w mu sigma)``; matched at the surface it gives the moment
    ``2 pi a^3 / mu_0 (2 mu_r - q) / (mu_r + q)`` with ``q = x^2 / (x coth x - 1) - 1``
    (J. R. Wait, Geophysics 16, 1951, p. 666). The limits are -2 pi a^3 / mu_0 for a perfect
    conductor and ``4 pi a^3 / mu_0 (mu_r - 1) / (mu_r + 2)`` for a permeable insulator, whose
    conductivity is 0. ``omega`` (K,) is in rad/s, the moments (K,) per flux density in A m^2 / T.

    Raises
    ------
    ValueError
        When the radius or permeability is not positive, or another value is negative.
    """
    if not (radius_m > 0 and relative_permeability > 0):
        raise ValueError('radius and relative permeability must be positive')
    if not (conductivity_s_per_m >= 0 and np.all(np.asarray(omega) >= 0)):
        raise ValueError('conductivity and frequencies must not be negative')
    mu = relative_permeability
    x = radius_m * np.sqrt(1j * np.asarray(omega) * conductivity_s_per_m * mu * MU_0)
    small = np.abs(x) < SMALL
    large = np.where(small, 1.0, x)
    q = np.where(small, 2.0 + x**2 / 5.0, large**2 / (large / np.tanh(large) - 1.0) - 1.0)
    return np.asarray(2 * np.pi * radius_m**3 / MU_0 * (2 * mu - q) / (mu + q))
