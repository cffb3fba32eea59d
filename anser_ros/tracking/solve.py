"""Pose of one coil from its complex fluxes: damped least squares with the dipoles' own gradient.

The unknowns are the position and the unit axis; the axis moves by a two-parameter step in its
tangent plane, so that no direction is singular. In-phase and quadrature parts are fitted together,
each divided by its standard deviation: the residual has no unit, and a step is small when it is
small against the pose's own uncertainty. The damping is Marquardt's (Nocedal and Wright, Numerical
Optimization, section 10.3); each trial costs one evaluation of the field and of its gradient.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.physics.dipole import GAUSS_OFFSET, fill_field_and_gradient

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MAX_EVALUATIONS = 40
LARGEST_MOVE_M = 0.04
LARGEST_TURN = 0.6
CONVERGED_CHI2 = 1e-6
"""Fall of chi-square below which a step is not worth another one (a thousandth of a sigma)."""


@dataclass(frozen=True)
class RealField:
    """A field model laid out for the kernels.

    Attributes
    ----------
    positions, directions : ndarray, shape (N, 3)
        Dipole positions (m, frame fg) and unit directions.
    moments : ndarray, shape (N, 2K)
        A m^2; for every emitter its real part, then its imaginary part.
    """

    positions: Array
    directions: Array
    moments: Array

    @classmethod
    def of(
        cls,
        positions: NDArray[np.generic],
        directions: NDArray[np.generic],
        moments: NDArray[np.generic],
    ) -> 'RealField':
        """Lay out dipoles with complex magnitudes, shape (N, K).

        Raises
        ------
        TrackingError
            When the shapes don't fit or a value is not finite.
        """
        r = np.ascontiguousarray(positions, dtype=np.float64)
        u = np.ascontiguousarray(directions, dtype=np.float64)
        m = np.ascontiguousarray(moments, dtype=np.complex128)
        if r.ndim != 2 or r.shape[1:] != (3,) or r.shape != u.shape or m.ndim != 2:
            raise TrackingError(
                f'a field model needs positions and directions (n, 3) and moments (n, k), '
                f'got {r.shape}, {u.shape} and {m.shape}'
            )
        if m.shape[0] != r.shape[0] or m.shape[0] == 0 or m.shape[1] == 0:
            raise TrackingError(f'{r.shape[0]} dipoles can not have moments of shape {m.shape}')
        if not (np.isfinite(r).all() and np.isfinite(u).all() and np.isfinite(m).all()):
            raise TrackingError('a field model must be finite')
        return cls(r, u, m.view(np.float64))

    @property
    def emitters(self) -> int:
        """Number K of emitters."""
        return int(self.moments.shape[1]) // 2


@dataclass(frozen=True)
class CoilSolution:
    """Where a coil's solve ended.

    Attributes
    ----------
    position : ndarray, shape (3,)
        m, frame fg.
    axis : ndarray, shape (3,)
        Unit sensitive axis.
    chi2 : float
        Sum of squared whitened residuals.
    normal : ndarray, shape (6, 6)
        ``J^T J`` of the whitened residuals by position (per m) and free axis vector.
    residual : ndarray, shape (2K,)
        Measured minus modelled flux, T; real and imaginary part by turns.
    evaluations : int
        Field evaluations used.
    converged : bool
        Whether the last step was negligible.
    """

    position: Array
    axis: Array
    chi2: float
    normal: Array
    residual: Array
    evaluations: int
    converged: bool


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
    for k in range(width):
        total = 0.0
        for j in range(width):
            total += whitening[k, j] * residual[j]
        white[0, k] = total
        chi2 += total * total
    for i in range(6):
        for k in range(width):
            total = 0.0
            for j in range(width):
                total += whitening[k, j] * jacobian[i, j]
            white[i + 1, k] = total
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
    used, damping, growth, converged = 1, 1e-4, 2.0, False
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
            _advance(position, axis, tangent, step, low, high, trial_position, trial_axis)
            fill_coil(
                trial_position, trial_axis, length, positions, directions, moments, basis, model,
                jacobian,
            )  # fmt: skip
            used += 1
            trial = _whiten(flux, model, jacobian, whitening, trial_residual, trial_white)
            negligible = promised < CONVERGED_CHI2 + 1e-9 * chi2
            if trial <= chi2 or negligible:
                if trial <= chi2:
                    gain = (chi2 - trial) / max(promised, 1e-300)
                    damping *= max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3)
                    growth = 2.0
                    converged = negligible or chi2 - trial < CONVERGED_CHI2 + 1e-9 * chi2
                    chi2 = trial
                    position[:] = trial_position
                    axis[:] = trial_axis
                    residual[:] = trial_residual
                    white, trial_white = trial_white, white
                    accepted = True
                else:
                    converged = True
                    break
            else:
                damping *= growth
                growth *= 2.0
                if damping > 1e12:
                    return chi2, used, False
        if 2 * used > budget and chi2 > give_up:
            break
    fill_tangent(axis, tangent)
    _normal_equations(white, tangent, full, normal, gradient)
    return chi2, used, converged


def whitening_of(sigma: Array, modes: Array | None = None) -> Array:
    """Matrix that turns a flux residual into one of unit covariance.

    Parameters
    ----------
    sigma : ndarray, shape (2K,)
        Standard deviation of each flux component, T.
    modes : ndarray, shape (R, 2K), or None
        Flux errors of one standard deviation each, T, common to several components (what the
        model's own uncertainty does at this pose).

    Returns
    -------
    ndarray, shape (1, 2K) or (2K, 2K)
        1/T: the diagonal alone where there are no modes, else the inverse of the covariance's
        Cholesky factor.

    Raises
    ------
    TrackingError
        When a sigma is not positive and finite.
    """
    deviations = np.asarray(sigma, dtype=np.float64)
    if not (np.isfinite(deviations).all() and (deviations > 0).all()):
        raise TrackingError('flux standard deviations must be positive and finite')
    if modes is None or len(modes) == 0:
        return np.ascontiguousarray(1.0 / deviations[None, :])
    scaled = np.asarray(modes, dtype=np.float64) / deviations
    if not np.isfinite(scaled).all():
        raise TrackingError('the model covariance must be finite')
    factor = np.linalg.cholesky(np.eye(len(deviations)) + scaled.T @ scaled)
    return np.ascontiguousarray(np.linalg.inv(factor) / deviations)


def solve_coil(
    field: RealField,
    flux: Array,
    whitening: Array,
    position: NDArray[np.generic],
    axis: NDArray[np.generic],
    low: Array,
    high: Array,
    length_m: float = 0.0,
    budget: int = MAX_EVALUATIONS,
    give_up: float = math.inf,
) -> CoilSolution:
    """Fit a coil's pose from a start near it.

    Parameters
    ----------
    field : RealField
    flux : ndarray, shape (2K,)
        Measured flux, T; real and imaginary part by turns.
    whitening : ndarray, shape (1, 2K) or (2K, 2K)
        From `whitening_of`.
    position, axis : ndarray, shape (3,)
        Start: m, frame fg, and unit axis.
    low, high : ndarray, shape (3,)
        Box that the position must not leave, m.
    length_m : float
        Coil length; 0 for a point sensor.
    budget : int
        Most field evaluations allowed.
    give_up : float
        Chi-square that must be undercut in half the budget.

    Returns
    -------
    CoilSolution

    Raises
    ------
    TrackingError
        When ``flux`` doesn't have two values for every emitter.
    """
    width = field.moments.shape[1]
    if flux.shape != (width,) or whitening.shape[1:] != (width,):
        raise TrackingError(
            f'the model has {width} flux components, got flux {flux.shape} and whitening '
            f'{whitening.shape}'
        )
    r, n = np.array(position, dtype=np.float64), np.array(axis, dtype=np.float64)
    normal, residual = np.empty((6, 6)), np.empty(width)
    chi2, used, converged = descend(
        r, n, length_m, flux, whitening, field.positions, field.directions, field.moments, low,
        high, budget, give_up, normal, residual,
    )  # fmt: skip
    return CoilSolution(r, n, chi2, normal, residual, used, converged)
