"""Kernels of a single coil's solve: its flux and slopes, whitening, damped steps, descent.

Compiled; `solve` is what calls them. A coil's pose is its position and its unit axis, which moves
by a two-parameter step in its tangent plane. The damping is Marquardt's (Nocedal and Wright,
Numerical Optimization, section 10.3); each trial costs one evaluation of field and gradient.
"""

import math

import numba
import numpy as np

from anser_ros.physics.dipole import GAUSS_OFFSET, fill_field_and_gradient

LARGEST_MOVE_M = 0.04
LARGEST_TURN = 0.6
FIRST_DAMPING = 1e-8
"""Next to nothing: most starts are so near that the plain step ends within the noise."""
LEAST_RAISED = 1e-3
"""Damping after a step that failed."""
CONVERGED_CHI2 = 1e-6
"""Fall of chi-square below which a step is not worth another one (a thousandth of a sigma)."""


@numba.njit(cache=True, error_model='numpy')
def fill_coil(point, axis, length, positions, directions, moments, basis, flux, jacobian):  # type: ignore[no-untyped-def]
    """Write a coil's flux (2K) and its derivatives (6, 2K) by position and free axis vector."""
    half = length * GAUSS_OFFSET
    count = 1 if half == 0.0 else 2
    share = 1.0 / count
    n0, n1, n2 = axis[0], axis[1], axis[2]
    flux[:] = 0.0
    jacobian[:] = 0.0
    at = np.empty(3)
    for s in range(count):
        h = half * (1 - 2 * s)
        for i in range(3):
            at[i] = point[i] + h * axis[i]
        fill_field_and_gradient(at, positions, directions, basis)
        f = np.dot(basis, moments)
        for k in range(moments.shape[1]):
            gx = share * (n0 * f[3, k] + n1 * f[4, k] + n2 * f[5, k])
            gy = share * (n0 * f[4, k] + n1 * f[6, k] + n2 * f[7, k])
            gz = share * (n0 * f[5, k] + n1 * f[7, k] + n2 * f[8, k])
            flux[k] += share * (n0 * f[0, k] + n1 * f[1, k] + n2 * f[2, k])
            jacobian[0, k] += gx
            jacobian[1, k] += gy
            jacobian[2, k] += gz
            jacobian[3, k] += share * f[0, k] + h * gx
            jacobian[4, k] += share * f[1, k] + h * gy
            jacobian[5, k] += share * f[2, k] + h * gz


@numba.njit(cache=True, error_model='numpy')
def fill_tangent(n, t):  # type: ignore[no-untyped-def]
    """Write two unit vectors that complete the unit vector ``n`` to a right-handed frame.

    Duff et al., Building an orthonormal basis, revisited, JCGT 2017: no direction is singular.
    """
    sign = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    t[0, 0], t[0, 1], t[0, 2] = 1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]
    t[1, 0], t[1, 1], t[1, 2] = b, sign + n[1] * n[1] * a, -n[1]


@numba.njit(cache=True, error_model='numpy')
def _whiten(flux, model, jacobian, whitening, residual, white):  # type: ignore[no-untyped-def]
    """Row 0 of ``white``: residual; rows 1 to 6: the flux's derivatives. Returns chi-square."""
    width = flux.shape[0]
    chi2 = 0.0
    for k in range(width):
        residual[k] = flux[k] - model[k]
    if whitening.shape[0] == 1:
        for k in range(width):
            w = whitening[0, k]
            white[0, k] = w * residual[k]
            chi2 += white[0, k] * white[0, k]
            for i in range(6):
                white[i + 1, k] = w * jacobian[i, k]
        return chi2
    # The factor is lower triangular. Columns outside, so that the inner loop runs along rows.
    for k in range(width):
        for i in range(7):
            white[i, k] = 0.0
        for j in range(k + 1):
            w = whitening[k, j]
            white[0, k] += w * residual[j]
            for i in range(6):
                white[i + 1, k] += w * jacobian[i, j]
        chi2 += white[0, k] * white[0, k]
    return chi2


@numba.njit(cache=True, error_model='numpy')
def _normal_equations(white, tangent, full, normal, gradient):  # type: ignore[no-untyped-def]
    """``full`` (6, 6) by position and free axis; ``normal``, ``gradient`` in the tangent plane."""
    g = np.zeros(6)
    for i in range(6):
        for j in range(i, 6):
            total = 0.0
            for k in range(white.shape[1]):
                total += white[i + 1, k] * white[j + 1, k]
            full[i, j] = total
            full[j, i] = total
        for k in range(white.shape[1]):
            g[i] += white[i + 1, k] * white[0, k]
    for i in range(3):
        gradient[i] = g[i]
        for j in range(3):
            normal[i, j] = full[i, j]
        for a in range(2):
            total = 0.0
            for j in range(3):
                total += full[i, 3 + j] * tangent[a, j]
            normal[i, 3 + a] = total
            normal[3 + a, i] = total
    for a in range(2):
        gradient[3 + a] = tangent[a, 0] * g[3] + tangent[a, 1] * g[4] + tangent[a, 2] * g[5]
        for b in range(2):
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += tangent[a, i] * full[3 + i, 3 + j] * tangent[b, j]
            normal[3 + a, 3 + b] = total


@numba.njit(cache=True, error_model='numpy')
def _damped_step(normal, gradient, damping, factor, step):  # type: ignore[no-untyped-def]
    """Solve ``(A + damping diag A) step = gradient`` by Cholesky; False when A is not positive."""
    n = gradient.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = normal[i, j]
            if i == j:
                total += damping * normal[i, i] + 1e-300
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(n):
        total = gradient[i]
        for k in range(i):
            total -= factor[i, k] * step[k]
        step[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * step[k]
        step[i] = total / factor[i, i]
    return True


@numba.njit(cache=True, error_model='numpy')
def _limit(step):  # type: ignore[no-untyped-def]
    """Shorten a step to the largest move and turn that the local model is trusted for."""
    move = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    turn = math.sqrt(step[3] ** 2 + step[4] ** 2)
    part = 1.0
    if move > LARGEST_MOVE_M:
        part = LARGEST_MOVE_M / move
    if turn * part > LARGEST_TURN:
        part = LARGEST_TURN / turn
    if part < 1.0:
        for i in range(5):
            step[i] *= part


@numba.njit(cache=True, error_model='numpy')
def _advance(position, axis, tangent, step, low, high, new_position, new_axis):  # type: ignore[no-untyped-def]
    """Take a step: the position stays in the box, the axis stays a unit vector."""
    norm = 0.0
    for i in range(3):
        new_position[i] = min(max(position[i] + step[i], low[i]), high[i])
        new_axis[i] = axis[i] + step[3] * tangent[0, i] + step[4] * tangent[1, i]
        norm += new_axis[i] * new_axis[i]
    norm = 1.0 / math.sqrt(norm)
    for i in range(3):
        new_axis[i] *= norm


@numba.njit(cache=True, error_model='numpy')
def _promised(normal, gradient, step):  # type: ignore[no-untyped-def]
    """Fall of chi-square that the local model promises for a step."""
    total = 0.0
    for i in range(5):
        row = 0.0
        for j in range(5):
            row += normal[i, j] * step[j]
        total += step[i] * (2.0 * gradient[i] - row)
    return total


@numba.njit(cache=True, error_model='numpy')
def descend(  # type: ignore[no-untyped-def]
    position, axis, length, flux, whitening, positions, directions, moments, low, high, budget,
    give_up, full, residual,
):  # fmt: skip
    """Move ``position`` and ``axis`` (in place) to the least chi-square near them.

    ``give_up``: a chi-square that a start must have come below after half its budget.
    Returns chi-square, evaluations used, whether it converged.
    """
    width = flux.shape[0]
    basis = np.empty((9, positions.shape[0]))
    model, jacobian = np.empty(width), np.empty((6, width))
    white, trial_white = np.empty((7, width)), np.empty((7, width))
    trial_residual = np.empty(width)
    tangent, step = np.empty((2, 3)), np.empty(5)
    normal, gradient, factor = np.empty((5, 5)), np.empty(5), np.empty((5, 5))
    trial_position, trial_axis = np.empty(3), np.empty(3)

    fill_coil(position, axis, length, positions, directions, moments, basis, model, jacobian)
    chi2 = _whiten(flux, model, jacobian, whitening, residual, white)
    used, damping, growth, converged = 1, FIRST_DAMPING, 2.0, False
    while used < budget and not converged:
        fill_tangent(axis, tangent)
        _normal_equations(white, tangent, full, normal, gradient)
        accepted = False
        while used < budget and not accepted:
            if not _damped_step(normal, gradient, damping, factor, step):
                damping = max(10.0 * damping, 1e-8)
                if damping > 1e12:
                    return chi2, used, False
                continue
            _limit(step)
            promised = _promised(normal, gradient, step)
            negligible = promised < CONVERGED_CHI2 + 1e-9 * chi2
            if negligible:
                converged = True
                break
            _advance(position, axis, tangent, step, low, high, trial_position, trial_axis)
            fill_coil(
                trial_position, trial_axis, length, positions, directions, moments, basis, model,
                jacobian,
            )  # fmt: skip
            used += 1
            trial = _whiten(flux, model, jacobian, whitening, trial_residual, trial_white)
            if trial <= chi2:
                gain = (chi2 - trial) / max(promised, 1e-300)
                damping *= max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3)
                growth = 2.0
                converged = chi2 - trial < CONVERGED_CHI2 + 1e-9 * chi2
                chi2 = trial
                position[:] = trial_position
                axis[:] = trial_axis
                residual[:] = trial_residual
                white, trial_white = trial_white, white
                accepted = True
            else:
                damping = max(damping * growth, LEAST_RAISED)
                growth *= 2.0
                if damping > 1e12:
                    return chi2, used, False
        if 2 * used > budget and chi2 > give_up:
            break
    fill_tangent(axis, tangent)
    _normal_equations(white, tangent, full, normal, gradient)
    return chi2, used, converged
