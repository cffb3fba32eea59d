"""Biot-Savart field of straight current filaments, in closed form, and sensors of finite length.

Signs are the textbook's: a current along +z makes a field along +y at a point on the +x axis.
Source: any textbook, e.g. Jackson, Classical Electrodynamics, section 5.2, integrated over a
straight piece from A to B with r1 = P - A and r2 = P - B:

    B = mu0 I / 4 pi * (r1 x r2) (|r1| + |r2|) / (|r1| |r2| (|r1| |r2| + r1 . r2))
"""

import math

import numpy as np
from numba import njit

MU_0 = 4e-7 * math.pi
NODES = 4
"""Gauss points along a sensor."""


@njit(cache=True, fastmath=True)
def _piece(p, start, end):
    ax, ay, az = p[0] - start[0], p[1] - start[1], p[2] - start[2]
    bx, by, bz = p[0] - end[0], p[1] - end[1], p[2] - end[2]
    a = math.sqrt(ax * ax + ay * ay + az * az)
    b = math.sqrt(bx * bx + by * by + bz * bz)
    f = 1e-7 * (a + b) / (a * b * (a * b + ax * bx + ay * by + az * bz))
    return f * (ay * bz - az * by), f * (az * bx - ax * bz), f * (ax * by - ay * bx)


@njit(cache=True, fastmath=True)
def _coils(points, start, end, owner, count):
    out = np.zeros((points.shape[0], count, 3))
    for i in range(points.shape[0]):
        for s in range(start.shape[0]):
            x, y, z = _piece(points[i], start[s], end[s])
            k = owner[s]
            out[i, k, 0] += x
            out[i, k, 1] += y
            out[i, k, 2] += z
    return out


def coil_field(points, coils):
    """Field (P, K, 3), T/A, of K closed paths at points (P, 3), m, each carrying one ampere.

    Of each path there are the corners (M, 3), m; the last is joined to the first.
    """
    start = np.concatenate(coils)
    end = np.concatenate([np.roll(path, -1, axis=0) for path in coils])
    owner = np.concatenate([np.full(len(path), k) for k, path in enumerate(coils)])
    keep = np.linalg.norm(end - start, axis=1) > 1e-9
    points = np.ascontiguousarray(points, dtype=np.float64)
    return _coils(points, start[keep], end[keep], owner[keep], len(coils))


def along(points, axes, lengths):
    """Gauss points (..., Q, 3), m, along sensors, and their weights (Q,), which add up to one.

    Sensors have middles and unit axes (..., 3) and lengths (...), m; where all are points, there
    is one node only.
    """
    if not np.any(lengths):
        return points[..., None, :], np.ones(1)
    x, w = np.polynomial.legendre.leggauss(NODES)
    step = 0.5 * lengths[..., None, None] * x[:, None]
    return points[..., None, :] + step * axes[..., None, :], 0.5 * w
