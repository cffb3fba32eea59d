"""Computes the field of straight current-carrying tracks by the textbook's Biot-Savart law and
sign.

A segment from A to B with the current I flowing from A to B makes, at the offsets ``a = P - A``
and ``b = P - B``, ``B = mu0 I/(4 pi) (a x b) (|a| + |b|) / (|a| |b| (|a| |b| + a . b))``, which is
the integral of ``dl x r / r^3`` in closed form (Hanson and Hirshman, Phys. Plasmas 9, 2002). No
digits cancel at points near the line that extends the segment. Only closed paths have a field
that is curl-free outside the copper, and only such a field can be fitted by dipoles.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.kernel_cache import kernel
from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.physics.dipole import rows_of

Array = NDArray[np.float64]


@kernel
def _add_segments(starts, ends, points, factor, out):  # type: ignore[no-untyped-def]
    for p in range(points.shape[0]):
        bx, by, bz = 0.0, 0.0, 0.0
        for s in range(starts.shape[0]):
            ax, ay, az = (
                points[p, 0] - starts[s, 0],
                points[p, 1] - starts[s, 1],
                points[p, 2] - starts[s, 2],
            )
            cx, cy, cz = (
                points[p, 0] - ends[s, 0],
                points[p, 1] - ends[s, 1],
                points[p, 2] - ends[s, 2],
            )
            a = np.sqrt(ax * ax + ay * ay + az * az)
            c = np.sqrt(cx * cx + cy * cy + cz * cz)
            product = a * c
            weight = (a + c) / (product * (product + ax * cx + ay * cy + az * cz))
            bx += weight * (ay * cz - az * cy)
            by += weight * (az * cx - ax * cz)
            bz += weight * (ax * cy - ay * cx)
        out[p, 0] += factor * bx
        out[p, 1] += factor * by
        out[p, 2] += factor * bz


def segment_field(
    starts: NDArray[np.generic],
    ends: NDArray[np.generic],
    points: NDArray[np.generic],
    current_a: float = 1.0,
) -> Array:
    """Return the field (P, 3), T, of straight segments that all carry the same current.

    It flows from ``starts`` to ``ends`` (M, 3), m; none of the ``points`` (P, 3), m, may lie on a
    segment.

    Raises
    ------
    ValueError
        When the shapes do not fit together.
    """
    first, last = rows_of(starts, 3, 'starts'), rows_of(ends, 3, 'ends')
    at = rows_of(points, 3, 'points')
    if first.shape != last.shape:
        raise ValueError(f'starts and ends must match, got {first.shape} and {last.shape}')
    lengths = np.linalg.norm(last - first, axis=1)
    first, last = first[lengths > 0], last[lengths > 0]
    out = np.zeros_like(at)
    _add_segments(first, last, at, DIPOLE_CONSTANT * float(current_a), out)
    return out


def loop_field(
    corners: NDArray[np.generic], points: NDArray[np.generic], current_a: float = 1.0
) -> Array:
    """Return the field (P, 3), T, of a closed path of straight segments.

    The current flows from each of the ``corners`` (M, 3), m, to the next, and from the last to the
    first; none of the ``points`` (P, 3), m, may lie on the path.

    Raises
    ------
    ValueError
        When an array is not of shape (n, 3).
    """
    path = rows_of(corners, 3, 'corners')
    return segment_field(path, np.roll(path, -1, axis=0), points, current_a)


def loop_moment(corners: NDArray[np.generic], current_a: float = 1.0) -> Array:
    """Return the magnetic moment (3,), A m^2, of a closed path: ``I/2`` times all ``r x dr``."""
    path = rows_of(corners, 3, 'corners')
    cross = np.cross(path, np.roll(path, -1, axis=0))
    return np.asarray(0.5 * current_a * cross.sum(axis=0))
