"""Compiles the kernels of a single coil's solve: whitening, damped steps, descent.

Compiled; `solve` is what calls them. A coil's pose is its position and its unit axis, which moves
by a two-parameter step in its tangent plane. The damping is Marquardt's (Nocedal and Wright,
Numerical Optimization, section 10.3); each trial costs one evaluation of field and gradient.
"""

import math

import numpy as np

from anser_ros.kernel_cache import inlined, kernel
from anser_ros.physics.dipole import fill_coil_basis
from anser_ros.physics.rotations import fill_tangent

LARGEST_MOVE_M, LARGEST_TURN = 0.04, 0.6
"""Longest step of the descent: of the position, m, and of the axis, rad. Over this distance the
linearised field is no guide any more; shorter steps only need more evaluations."""
FIRST_DAMPING = 1e-8
"""Next to nothing: most starts are so near that the plain step ends within the noise."""
LEAST_RAISED = 1e-3
"""Damping at least after a step that failed. Growing from `FIRST_DAMPING` alone, several more
would fail until steps get shorter."""
MOST_DAMPING = 1e12
"""Damping beyond which no step can lead lower."""
CONVERGED_CHI2 = 1e-6
"""Fall of chi-square below which a step is not worth another one (a thousandth of a sigma)."""
TRUSTED_CHI2, TRUSTED_MOVE_M, TRUSTED_TURN = 0.03, 50e-6, 1e-3
"""Fall of chi-square, move and turn up to which a step is taken without a look at where it leads:
what a sixth of a sigma leaves, of second order, is less than a thousandth of a sigma."""


@inlined
def _whiten(flux, model, whitening, residual, white):  # type: ignore[no-untyped-def]
    """Row 0 of ``white``: residual; rows 1 to 6: the flux's derivatives. Returns chi-square.

    ``model`` (7, 2K): the modelled flux, then its derivatives.
    """
    width = flux.shape[0]
    chi2 = 0.0
    for k in range(width):
        residual[k] = flux[k] - model[0, k]
    if whitening.shape[0] == 1:
        for k in range(width):
            w = whitening[0, k]
            white[0, k] = w * residual[k]
            chi2 += white[0, k] * white[0, k]
            for i in range(6):
                white[i + 1, k] = w * model[i + 1, k]
        return chi2
    # The factor is lower triangular. Columns outside, so that the inner loop runs along rows.
    for k in range(width):
        for i in range(7):
            white[i, k] = 0.0
        for j in range(k + 1):
            w = whitening[k, j]
            white[0, k] += w * residual[j]
            for i in range(6):
                white[i + 1, k] += w * model[i + 1, j]
        chi2 += white[0, k] * white[0, k]
    return chi2


@inlined
def _normal_equations(white, axis, tangent, full, normal, gradient):  # type: ignore[no-untyped-def]
    """``full`` (6, 6) by position and free axis; ``normal``, ``gradient`` in the tangent plane."""
    fill_tangent(axis, tangent)
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


@kernel
def damped_step(normal, gradient, damping, factor, step):  # type: ignore[no-untyped-def]
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


@inlined
def limit_step(step):  # type: ignore[no-untyped-def]
    """Shorten a step to the largest move and turn that the local model is trusted for.

    Returns whether it is so short that its end need not be looked at.
    """
    move = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    turn = 0.0
    for i in range(3, step.shape[0]):
        turn += step[i] ** 2
    turn = math.sqrt(turn)
    part = 1.0
    if move > LARGEST_MOVE_M:
        part = LARGEST_MOVE_M / move
    if turn * part > LARGEST_TURN:
        part = LARGEST_TURN / turn
    if part < 1.0:
        for i in range(step.shape[0]):
            step[i] *= part
    return move < TRUSTED_MOVE_M and turn < TRUSTED_TURN


@inlined
def _advance(  # type: ignore[no-untyped-def]
    position, axis, tangent, normal, gradient, step, low, high, new_position, new_axis
):  # fmt: skip
    """Take a step: the position stays in the box, the axis stays a unit vector.

    Returns the fall of chi-square that the local model promises for it.
    """
    norm, promised = 0.0, 0.0
    for i in range(3):
        new_position[i] = min(max(position[i] + step[i], low[i]), high[i])
        new_axis[i] = axis[i] + step[3] * tangent[0, i] + step[4] * tangent[1, i]
        norm += new_axis[i] * new_axis[i]
    norm = 1.0 / math.sqrt(norm)
    for i in range(3):
        new_axis[i] *= norm
    for i in range(5):
        row = 0.0
        for j in range(5):
            row += normal[i, j] * step[j]
        promised += step[i] * (2.0 * gradient[i] - row)
    return promised


@kernel
def descend(  # type: ignore[no-untyped-def]
    positions, axes, lengths, fluxes, whitening, dipoles, moments, low, high, budget, normals,
    residuals, found,
):  # fmt: skip
    """Move ``positions`` and ``axes`` (S, 3; in place), a coil each, to the least chi-square near.

    ``found`` (S, 3): chi-square, evaluations used, whether it converged.
    """
    width = fluxes.shape[1]
    basis, white, trial_residual = (
        np.empty((1, 7, dipoles.shape[1])), np.empty((7, width)), np.empty(width)
    )  # fmt: skip
    tangent, step, factor = np.empty((2, 3)), np.empty(5), np.empty((5, 5))
    normal, gradient, trial_position, trial_axis = (
        np.empty((5, 5)), np.empty(5), np.empty(3), np.empty(3)
    )  # fmt: skip
    for s in range(positions.shape[0]):
        position, axis, residual = positions[s], axes[s], residuals[s]
        for i in range(3):
            trial_position[i], trial_axis[i] = position[i], axis[i]
        chi2, promised, used = 0.0, 0.0, 0
        damping, growth, converged = FIRST_DAMPING, 2.0, False
        while True:
            fill_coil_basis(
                trial_position.reshape(1, 3), trial_axis.reshape(1, 3), lengths[s : s + 1],
                dipoles, basis,
            )  # fmt: skip
            used += 1
            model = np.dot(basis[0], moments)
            trial = _whiten(fluxes[s], model, whitening[s], trial_residual, white)
            if used == 1 or trial <= chi2:
                if used > 1:
                    gain = (chi2 - trial) / max(promised, 1e-300)
                    damping *= max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3)
                    growth = 2.0
                    converged = chi2 - trial < CONVERGED_CHI2 + 1e-9 * chi2
                chi2 = trial
                for k in range(width):
                    residual[k] = trial_residual[k]
                for i in range(3):
                    position[i], axis[i] = trial_position[i], trial_axis[i]
                _normal_equations(white, axis, tangent, normals[s], normal, gradient)
            else:
                damping = max(damping * growth, LEAST_RAISED)
                growth *= 2.0
            has_step = False
            while used < budget and not (converged or has_step) and damping <= MOST_DAMPING:
                has_step = damped_step(normal, gradient, damping, factor, step)
                if not has_step:
                    damping = max(10.0 * damping, 1e-8)
            if not has_step:
                break
            short = limit_step(step)
            promised = _advance(
                position, axis, tangent, normal, gradient, step, low, high, trial_position,
                trial_axis,
            )  # fmt: skip
            negligible = promised < CONVERGED_CHI2 + 1e-9 * chi2
            if negligible or (short and promised < TRUSTED_CHI2):
                chi2 -= promised
                converged = True
                for i in range(3):
                    position[i], axis[i] = trial_position[i], trial_axis[i]
                break
        found[s, 0], found[s, 1], found[s, 2] = chi2, used, converged
