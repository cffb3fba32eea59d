"""Metal bodies as mutually coupled conducting, permeable spheres.

One sphere in a uniform field that varies as exp(+j w t) answers with the moment

    m = 4 pi a^3 (2 mu_r - g) / (2 (mu_r + g)) H,   g = (x i1(x))' / i1(x),   x = sqrt(j w mu s) a

where i1 is the modified spherical Bessel function of first order. It follows from A_phi and
H_theta being continuous at the surface (Landau & Lifshitz, Electrodynamics of Continuous Media,
section 59). Limits: 4 pi a^3 (mu_r - 1) / (mu_r + 2) at w = 0, -2 pi a^3 for a perfect conductor.
Spheres see each other as dipoles; one linear system a frequency is solved for all of them.
"""

from dataclasses import dataclass

import numpy as np
from filaments import MU_0
from numba import njit


@dataclass(frozen=True)
class Body:
    """A rigid body of N spheres."""

    place: np.ndarray  # centres (N, 3) in the body's own frame, m
    radius: np.ndarray  # m
    conductivity: np.ndarray  # S/m
    permeability: np.ndarray  # relative


def polarizability(radius, conductivity, permeability, omega):
    """Moment of a sphere by the flux density that it is in, A m^2 / T; arguments broadcast."""
    x = np.sqrt(1j * omega * MU_0 * permeability * conductivity) * radius
    t = np.tanh(x)
    small = np.abs(x) < 1e-2
    x = np.where(small, 1.0, x)
    t = np.where(small, 0.5, t)
    g = np.where(small, 2.0, (x * x * t - x + t) / (x - t))
    share = (2 * permeability - g) / (2 * (permeability + g))
    return 4 * np.pi * radius**3 * share / MU_0


def coupling(place):
    """Field of a unit moment at each sphere in every other one, (3N, 3N), T / (A m^2)."""
    count = len(place)
    away = place[:, None] - place[None]
    r = np.linalg.norm(away, axis=-1)
    np.fill_diagonal(r, 1.0)
    unit = away / r[..., None]
    blocks = 3 * unit[..., :, None] * unit[..., None, :] - np.eye(3)
    blocks *= (1e-7 / r**3)[..., None, None]
    blocks[np.arange(count), np.arange(count)] = 0.0
    return blocks.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)


def response(body, omega):
    """Moments by the flux densities at all spheres, (K, 3N, 3N), for K angular frequencies."""
    between = coupling(body.place)
    out = []
    for w in omega:
        alpha = polarizability(body.radius, body.conductivity, body.permeability, w)
        out.append(np.linalg.inv(np.diag(np.repeat(1 / alpha, 3)) - between))
    return np.array(out)


@njit(cache=True, fastmath=True)
def _dipoles(points, place, moments):
    count = moments.shape[2]
    out = np.zeros((points.shape[0], count, 3), dtype=np.complex128)
    for i in range(points.shape[0]):
        for n in range(place.shape[0]):
            x = points[i, 0] - place[n, 0]
            y = points[i, 1] - place[n, 1]
            z = points[i, 2] - place[n, 2]
            r2 = x * x + y * y + z * z
            f = 1e-7 / (r2 * np.sqrt(r2))
            for k in range(count):
                mx, my, mz = moments[n, 0, k], moments[n, 1, k], moments[n, 2, k]
                along = 3 * (mx * x + my * y + mz * z) / r2
                out[i, k, 0] += f * (along * x - mx)
                out[i, k, 1] += f * (along * y - my)
                out[i, k, 2] += f * (along * z - mz)
    return out


def dipole_field(points, place, moments):
    """Field (P, K, 3), T, of dipoles at (N, 3) with moments (N, 3, K), A m^2."""
    return _dipoles(np.ascontiguousarray(points), np.ascontiguousarray(place), moments)
