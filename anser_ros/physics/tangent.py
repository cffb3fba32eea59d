"""Spans the plane across a direction by two unit vectors."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.kernel_cache import kernel


@kernel
def fill_tangent(n, t):  # type: ignore[no-untyped-def]
    """Write two unit vectors that complete the unit vector ``n`` to a right-handed frame.

    Duff et al., Building an orthonormal basis, revisited, JCGT 2017: no direction is singular.
    """
    sign = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    t[0, 0], t[0, 1], t[0, 2] = 1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]
    t[1, 0], t[1, 1], t[1, 2] = b, sign + n[1] * n[1] * a, -n[1]


def tangents(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two unit vectors across each unit axis, shape (S, 2, 3), for axes of shape (S, 3)."""
    least = np.eye(3)[np.argmin(np.abs(axes), axis=1)]
    first = np.cross(axes, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axes, first)], axis=1)


def tilted(axes: NDArray[np.float64], tilt: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit axes (S, 3) stepped by ``tilt`` (S, 2), rad, along their `tangents`."""
    out = axes + np.einsum('st,stj->sj', tilt, tangents(axes))
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
