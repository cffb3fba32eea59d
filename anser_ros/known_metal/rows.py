"""Holds what coils read of metal, with what is known of their errors."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.known_metal.lattice import Coils

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class CoilReadings(NamedTuple):
    """Holds what coils read beyond the calibrated model, and how well that is known.

    Attributes
    ----------
    coils : Coils
    change : ndarray, shape (S, K), complex
        In the emitters' phases, T.
    shared : ndarray, shape (2 S K, m)
        Effect of errors of unit variance, T: real parts, then imaginary parts.
    """

    coils: Coils
    change: ComplexArray
    shared: Array


class MetalFrame(NamedTuple):
    """Holds what references and tools read of metal in one frame.

    Attributes
    ----------
    time : float
        s.
    readings : tuple of CoilReadings
        Of the references, then of each tool with a pose.
    place : ndarray, shape (3,)
        Where the refit sees the metal, m.
    """

    time: float
    readings: tuple[CoilReadings, ...]
    place: Array


def real_parts(values: NDArray[Any]) -> Array:
    """Return real and imaginary parts of rows, one after the other: (n, ...) to (2n, ...)."""
    return np.concatenate([values.real, values.imag])
