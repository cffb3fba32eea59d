"""Spans the plane across a direction by two unit vectors."""

import math

import numpy as np
from numpy.typing import NDArray

from anser_ros.kernel_cache import kernel


@kernel
def fill_tangent(n, t):  # type: ignore[no-untyped-def]
    """Write two unit vectors that complete the unit vector ``n`` to a right-handed frame.

    The first is across ``n`` and the axis of the frame that is most across it. Tilts in model
    files are along these two.
    """
    k = 0
    for i in range(1, 3):
        if abs(n[i]) < abs(n[k]):
            k = i
    i, j = (k + 1) % 3, (k + 2) % 3
    norm = math.sqrt(n[i] * n[i] + n[j] * n[j])
    t[0, k], t[0, i], t[0, j] = 0.0, n[j] / norm, -n[i] / norm
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        t[1, k] = n[i] * t[0, j] - n[j] * t[0, i]


def tangents(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two unit vectors across each unit axis, shape (S, 2, 3), for axes of shape (S, 3)."""
    out = np.empty((len(axes), 2, 3))
    for axis, pair in zip(np.ascontiguousarray(axes), out, strict=True):
        fill_tangent(axis, pair)
    return out


def tilted(axes: NDArray[np.float64], tilt: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit axes (S, 3) stepped by ``tilt`` (S, 2), rad, along their `tangents`."""
    out = axes + np.einsum('st,stj->sj', tilt, tangents(axes))
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
