"""Names the types of arrays that all packages use; complex values by their parts."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from anser_ros.errors import ParameterError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Single = NDArray[np.float32]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.int64]
AnyArray = NDArray[np.generic]


def complex_of(parts: Array) -> ComplexArray:
    """Return complex numbers (n,) from their real, then imaginary parts (2 n,)."""
    real, imaginary = parts.reshape(2, -1)
    return np.asarray(real + 1j * imaginary)


def as_real(values: NDArray[np.inexact]) -> Array:
    """Return complex values (..., K) as real ones (..., 2K), real and imaginary by turns."""
    return np.ascontiguousarray(values, dtype=np.complex128).view(np.float64)


def as_complex(values: Array) -> ComplexArray:
    """Return real values (..., 2K), as `as_real` makes them, as complex ones (..., K)."""
    return np.ascontiguousarray(values).view(np.complex128)


def pairs_of(values: ComplexArray) -> Any:
    """Return complex numbers as a record has them, as lists of [re, im]."""
    return np.stack([values.real, values.imag], axis=-1).tolist()


def numbers_of(given: ArrayLike, what: str, last: int | None = None, below: float = 0) -> Array:
    """Return an array, whose last axis has a length, of values below a bound, m, unless that is 0.

    Raises `ParameterError` if it is none.
    """
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ParameterError(f'{what} must be numbers: {error}') from error
    if last is not None and values.shape[-1:] != (last,):
        raise ParameterError(f'{what} must be (..., {last}), got {values.shape}')
    if below and not (np.abs(values) < below).all():
        raise ParameterError(f'{what} must be finite and below {below:g} m: are they in mm?')
    return values
