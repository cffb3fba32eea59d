"""Holds what coils read of metal, with what is known of their errors."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.known_metal.lattice import Coils

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class CoilReadings(NamedTuple):
    """Holds what coils read beyond the calibrated model, (S, K), T, in the emitters' phases.

    ``shared`` (2 S K, m) is the effect of errors of unit variance, T: real parts, then imaginary.
    """

    coils: Coils
    change: ComplexArray
    shared: Array


class MetalFrame(NamedTuple):
    """Holds what references and tools read of metal in one frame, at a time in s.

    The readings are those of the references, then of each tool with a pose; ``place`` (3,), m, is
    where the refit sees the metal.
    """

    time: float
    readings: tuple[CoilReadings, ...]
    place: Array


def real_parts(values: NDArray[Any]) -> Array:
    """Return real and imaginary parts of rows, one after the other: (n, ...) to (2n, ...)."""
    return np.concatenate([values.real, values.imag])
