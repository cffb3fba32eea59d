"""Finds the axis about which a field model may be turned without a change of its field."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OFF_AXIS = 1e-6
"""Moment across the axis, as a fraction of the whole, and distance from the axis as a fraction of
a metre, up to which a dipole is on it: far below what anybody can measure."""


@dataclass(frozen=True)
class SymmetryAxis:
    """Describes an axis of rotation that leaves a field as it is.

    Attributes
    ----------
    point : ndarray, shape (3,)
        The middle of the sources on it, m, frame fg: that of their moments, about which their
        field has no quadrupole.
    direction : ndarray, shape (3,)
        Unit vector; the first emitter's moment points along it.
    """

    point: Array
    direction: Array


def symmetry_axis(
    positions: Array, directions: Array, moments: NDArray[np.complex128]
) -> SymmetryAxis | None:
    """Return the axis on which all dipoles lie and along which all moments point, if there is one.

    Parameters
    ----------
    positions, directions : ndarray, shape (N, 3)
        Places (m) and unit directions of the dipoles, frame fg.
    moments : ndarray, shape (N, K)
        A m^2, for each emitter.
    """
    size = np.abs(moments)
    strong = size > OFF_AXIS * size.max()
    used = strong.any(axis=1)
    if not used.any():
        return None
    places = positions[used]
    vectors = (moments.real @ np.ones(moments.shape[1]))[:, None] * directions
    total = vectors.sum(axis=0)
    if np.linalg.norm(total) < OFF_AXIS * size.sum():
        return None
    axis = total / np.linalg.norm(total)
    weight = vectors[used] @ axis
    middle = weight @ places / weight.sum()
    away = places - middle
    away -= np.outer(away @ axis, axis)
    if np.abs(away).max() > OFF_AXIS:
        return None
    # Dipoles at one place count together: three components of one vector may point anywhere.
    whole = np.einsum('nk,ni->ki', moments, directions)
    keys = np.round(places / OFF_AXIS).astype(np.int64)
    for place in np.unique(keys, axis=0):
        here = np.flatnonzero(used)[(keys == place).all(axis=1)]
        vector = np.einsum('nk,ni->ki', moments[here], directions[here])
        across = vector - np.einsum('ki,i->k', vector, axis)[:, None] * axis
        if np.linalg.norm(across) > OFF_AXIS * np.linalg.norm(whole):
            return None
    return SymmetryAxis(middle, axis)
