"""Holds constants of nature for field computations, in SI units, and the size of a radian."""

import math

MU_0 = 4e-7 * math.pi
"""Vacuum permeability, T m / A (the pre-2019 exact value; CODATA differs by 6e-10)."""

DIPOLE_CONSTANT = MU_0 / (4 * math.pi)
"""mu_0 / (4 pi), T m / A."""

DEGREES = 180.0 / math.pi
"""Degrees in a radian, the factor from SI to what tables and figures show."""
