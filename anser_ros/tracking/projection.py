"""Descends by position alone: the axis is the best one at every position (variable projection).

From far away the joint descent is slow and ends in false minima, because position and axis trade
against each other. With the axis eliminated three unknowns remain, and the slopes are those that
no turn of the axis can undo (Golub and Pereyra 1973, with Kaufman's simplification). The coil is
taken for a point; the joint descent that follows knows its length.
"""

import math

import numpy as np

from anser_ros.kernel_cache import kernel
from anser_ros.physics.dipole import fill_fields
from anser_ros.physics.tangent import fill_tangent
from anser_ros.tracking.descent import damped_step

LARGEST_MOVE_M = 0.05
"""Longest step of the position, m; beyond it the linearised field is no guide any more."""
AXIS_STEPS = 3
"""Newton steps that bring the linear solution for the axis to unit length; they converge
quadratically from a start that is nearly a unit vector."""
NEAR = 1e-4
"""A relative fall of chi-square below this ends the descent: the joint one does the rest."""


@kernel
def _turn(field, flux, axis, tangent, plane, residual):  # type: ignore[no-untyped-def]
    """Best small turn of the axis in a given whitened field (3, 2K); returns chi-square after it.

    ``plane`` (2, 2K) is left with the orthonormal directions that turns of the axis reach.
    """
    width = flux.shape[0]
    chi2 = 0.0
    for step in range(AXIS_STEPS + 1):
        chi2 = 0.0
        for k in range(width):
            residual[k] = flux[k] - (
                axis[0] * field[0, k] + axis[1] * field[1, k] + axis[2] * field[2, k]
            )
            chi2 += residual[k] * residual[k]
        fill_tangent(axis, tangent)
        a00, a01, a11, g0, g1 = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(width):
            u = (
                tangent[0, 0] * field[0, k]
                + tangent[0, 1] * field[1, k]
                + tangent[0, 2] * field[2, k]
            )
            v = (
                tangent[1, 0] * field[0, k]
                + tangent[1, 1] * field[1, k]
                + tangent[1, 2] * field[2, k]
            )
            plane[0, k], plane[1, k] = u, v
            a00 += u * u
            a01 += u * v
            a11 += v * v
            g0 += u * residual[k]
            g1 += v * residual[k]
        if step == AXIS_STEPS:
            break
        determinant = max(a00 * a11 - a01 * a01, 1e-12 * a00 * a11 + 1e-300)
        x, y = (a11 * g0 - a01 * g1) / determinant, (a00 * g1 - a01 * g0) / determinant
        size = math.sqrt(x * x + y * y)
        if size > 1.0:
            x, y = x / size, y / size
        norm = 0.0
        for i in range(3):
            axis[i] += x * tangent[0, i] + y * tangent[1, i]
            norm += axis[i] * axis[i]
        for i in range(3):
            axis[i] /= math.sqrt(norm)
    length = math.sqrt(max(a00, 1e-300))
    dot = 0.0
    for k in range(width):
        plane[0, k] /= length
        dot += plane[0, k] * plane[1, k]
    length = 1e-300
    for k in range(width):
        plane[1, k] -= dot * plane[0, k]
        length += plane[1, k] * plane[1, k]
    for k in range(width):
        plane[1, k] /= math.sqrt(length)
    return chi2


@kernel
def _look(  # type: ignore[no-untyped-def]
    position, axis, flux, inverse_sigma, dipoles, moments, basis, tangent, plane, residual, normal,
    gradient,
):  # fmt: skip
    """Best axis at a position; returns chi-square with it.

    ``normal`` (3, 3) and ``gradient`` (3,) are left for a step of the position.
    """
    width = flux.shape[0]
    place = np.empty((1, 3))
    for i in range(3):
        place[0, i] = position[i]
    fill_fields(place, dipoles, basis)
    f = np.dot(basis[0], moments)
    for k in range(width):
        for i in range(9):
            f[i, k] *= inverse_sigma[k]
    chi2 = _turn(f[:3], flux, axis, tangent, plane, residual)
    n0, n1, n2 = axis[0], axis[1], axis[2]
    slopes = f[3:6]
    for k in range(width):
        xx, xy, xz, yy, yz, zz = f[3, k], f[4, k], f[5, k], f[6, k], f[7, k], f[8, k]
        slopes[0, k] = n0 * xx + n1 * xy + n2 * xz
        slopes[1, k] = n0 * xy + n1 * yy + n2 * yz
        slopes[2, k] = n0 * xz + n1 * yz + n2 * zz
    for i in range(3):
        for p in range(2):
            dot = 0.0
            for k in range(width):
                dot += plane[p, k] * slopes[i, k]
            for k in range(width):
                slopes[i, k] -= dot * plane[p, k]
    for i in range(3):
        gradient[i] = 0.0
        for k in range(width):
            gradient[i] += slopes[i, k] * residual[k]
        for j in range(i + 1):
            total = 0.0
            for k in range(width):
                total += slopes[i, k] * slopes[j, k]
            normal[i, j] = normal[j, i] = total
    return chi2


@kernel
def descend_projected(  # type: ignore[no-untyped-def]
    position, axis, flux, inverse_sigma, dipoles, moments, low, high, budget,
):  # fmt: skip
    """Move ``position`` and ``axis`` (in place) towards a minimum.

    ``flux`` is in tesla, ``dipoles`` (6, N) are `solve.RealField.columns`. Returns chi-square (of
    a point coil) and the evaluations used.
    """
    width = flux.shape[0]
    white, basis = flux * inverse_sigma, np.empty((1, 9, dipoles.shape[1]))
    tangent, plane, residual = np.empty((2, 3)), np.empty((2, width)), np.empty(width)
    normal, gradient, new_normal, new_gradient = (
        np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    )  # fmt: skip
    step, factor, new_position, new_axis = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    chi2 = _look(
        position, axis, white, inverse_sigma, dipoles, moments, basis, tangent, plane, residual,
        normal, gradient,
    )  # fmt: skip
    used, damping = 1, 1e-3
    while used < budget and damped_step(normal, gradient, damping, factor, step):
        size = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        part, moved = min(1.0, LARGEST_MOVE_M / max(size, 1e-300)), 0.0
        for i in range(3):
            new_position[i] = min(max(position[i] + part * step[i], low[i]), high[i])
            moved = max(moved, abs(new_position[i] - position[i]))
            new_axis[i] = axis[i]
        if moved < 1e-6:
            break
        trial = _look(
            new_position, new_axis, white, inverse_sigma, dipoles, moments, basis, tangent, plane,
            residual, new_normal, new_gradient,
        )  # fmt: skip
        used += 1
        if trial < chi2:
            done = chi2 - trial < NEAR * chi2
            chi2 = trial
            position[:], axis[:] = new_position, new_axis
            normal, new_normal = new_normal, normal
            gradient, new_gradient = new_gradient, gradient
            damping *= 0.2
            if done:
                break
        else:
            damping = max(8.0 * damping, 1e-4)
            if damping > 1e8:
                break
    return chi2, used
