"""What metal does to an alternating field: polarisability of spheres, coupled bodies, images.

Time convention exp(+j w t): a conductor's induced moment opposes the field, and lags by at most a
quarter period. One object is driven by all emitters at once; its moment for emitter k is its
polarisability times that emitter's field where it lies.
"""

import cmath
import math

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.constants import DIPOLE_CONSTANT, MU_0

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def sphere_polarisability(
    radius_m: float, conductivity: float, relative_permeability: float, frequency_hz: float
) -> complex:
    """Magnetic polarisability of a sphere: its moment is ``alpha B / mu0``.

    From the vector potential inside, ``i1(x r / a)`` with the modified spherical Bessel function
    and ``x = a sqrt(j w mu sigma)``, matched at the surface (Wait, Geophysics 16, 1951):
    ``alpha = 2 pi a^3 (2 mu_r - q) / (mu_r + q)``, ``q = x^2 / (x coth x - 1) - 1``.

    Parameters
    ----------
    radius_m : float
    conductivity : float
        S/m; 0 for an insulator.
    relative_permeability : float
    frequency_hz : float

    Returns
    -------
    complex
        m^3. The limits are -2 pi a^3 of a perfect conductor and
        ``4 pi a^3 (mu_r - 1) / (mu_r + 2)`` of a static field.

    Raises
    ------
    ValueError
        When the radius or permeability is not positive, or another value is negative.
    """
    if not (radius_m > 0 and relative_permeability > 0):
        raise ValueError('radius and relative permeability must be positive')
    if not (conductivity >= 0 and frequency_hz >= 0):
        raise ValueError('conductivity and frequency must not be negative')
    mu = MU_0 * relative_permeability
    x = radius_m * cmath.sqrt(2j * math.pi * frequency_hz * mu * conductivity)
    if abs(x) < 1e-2:
        q = 2.0 + x * x / 5.0
    else:
        decay = cmath.exp(-2.0 * x)
        q = x * x / (x * (1.0 + decay) / (1.0 - decay) - 1.0) - 1.0
    permeability = relative_permeability
    return 2 * math.pi * radius_m**3 * (2 * permeability - q) / (permeability + q)


def dipole_tensor(points: NDArray[np.generic], sources: NDArray[np.generic]) -> Array:
    """Field at points per vector moment at sources, shape (P, S, 3, 3), T/(A m^2).

    A point's own position gives zero: a body does not drive itself.
    """
    d = np.asarray(points, dtype=np.float64)[:, None] - np.asarray(sources, dtype=np.float64)
    square = np.einsum('psi,psi->ps', d, d)
    same = square == 0.0
    square = np.where(same, 1.0, square)
    tensor = 3.0 * np.einsum('psi,psj->psij', d, d) / square[..., None, None] - np.eye(3)
    tensor *= (DIPOLE_CONSTANT * square**-1.5)[..., None, None]
    tensor[same] = 0.0
    return np.asarray(tensor)


def induced_moments(
    positions: NDArray[np.generic],
    polarisability: NDArray[np.generic],
    field: NDArray[np.generic],
    coupled: bool = True,
) -> ComplexArray:
    """Moments of metal bodies in the fields of all emitters.

    Parameters
    ----------
    positions : ndarray, shape (Q, 3)
        Body centres, m.
    polarisability : ndarray, shape (Q,) or (Q, K)
        m^3; one a body, or one a body and emitter (it depends on the frequency).
    field : ndarray, shape (Q, K, 3)
        Each emitter's field where the bodies lie, T.
    coupled : bool
        Whether the bodies also drive each other.

    Returns
    -------
    ndarray, shape (Q, K, 3), complex
        A m^2.

    Raises
    ------
    ValueError
        When shapes don't fit.
    """
    at = np.asarray(positions, dtype=np.float64)
    drive = np.asarray(field, dtype=np.complex128)
    alpha = np.asarray(polarisability, dtype=np.complex128)
    if alpha.ndim == 1:
        alpha = np.broadcast_to(alpha[:, None], drive.shape[:2])
    if at.ndim != 2 or drive.shape != (len(at), alpha.shape[1], 3) or alpha.shape[0] != len(at):
        raise ValueError(
            f'{at.shape} positions, {np.shape(polarisability)} polarisabilities and '
            f'{drive.shape} fields do not match'
        )
    moments = alpha[:, :, None] * drive / MU_0
    if not coupled or len(at) < 2:
        return np.asarray(moments)
    tensor = dipole_tensor(at, at)
    size = 3 * len(at)
    for k in range(drive.shape[1]):
        back = (alpha[:, k, None, None, None] / MU_0) * tensor
        matrix = np.eye(size) - back.swapaxes(1, 2).reshape(size, size)
        moments[:, k] = np.linalg.solve(matrix, moments[:, k].reshape(size)).reshape(-1, 3)
    return np.asarray(moments)


def plate_images(
    positions: NDArray[np.generic],
    moments: NDArray[np.generic],
    z_m: float,
    reflection: complex = 1.0,
) -> tuple[Array, ComplexArray]:
    """Image dipoles of an endless plate parallel to the board, for the field on the sources' side.

    Parameters
    ----------
    positions : ndarray, shape (N, 3)
        m.
    moments : ndarray, shape (N, ..., 3)
        Vector moments, A m^2.
    z_m : float
        Height of the plate's surface, m.
    reflection : complex
        1 for a perfect conductor (no normal field at its surface), -1 for endless permeability (no
        tangential one).

    Returns
    -------
    positions : ndarray, shape (N, 3)
        m.
    moments : ndarray, shape (N, ..., 3), complex
        A m^2.
    """
    mirrored = np.array(positions, dtype=np.float64)
    mirrored[:, 2] = 2.0 * z_m - mirrored[:, 2]
    image = reflection * np.array(moments, dtype=np.complex128)
    image[..., 2] *= -1.0
    return mirrored, image
