"""Constants of nature that the field computations share, in SI units."""

import math

MU_0 = 4e-7 * math.pi
"""Vacuum permeability, T m / A (the pre-2019 exact value; CODATA differs by 6e-10)."""

DIPOLE_CONSTANT = MU_0 / (4 * math.pi)
"""mu_0 / (4 pi), T m / A."""
