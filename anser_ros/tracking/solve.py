"""Solves for a coil's pose from complex fluxes, and computes how well the pose is known.

Damped least squares with the dipoles' own gradient (`descent`). In-phase and quadrature parts are
fitted together, each divided by its standard deviation: the residual has no unit, and a step is
small when it is small against the pose's own uncertainty.

The error of a pose comes from the flux noise and from the error of the field model. Both enter the
whitening, so the inverse of the whitened normal matrix is the covariance. Roll about a coil's axis
is not observable: the rotation covariance is that of the tilt plus ``roll_variance a a^T``.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from anser_ros.arrays import AnyArray, Array
from anser_ros.errors import TrackingError
from anser_ros.kernel_cache import kernel
from anser_ros.physics.dipole import dipole_rows
from anser_ros.physics.rotations import fill_tangent
from anser_ros.tracking.descent import damped_step, descend

MAX_EVALUATIONS = 40
"""Evaluations after which a descent is given up: good starts need a few, and a frame is short."""


@dataclass(frozen=True)
class RealField:
    """Holds a field model laid out for the kernels."""

    # positions, directions: (N, 3), dipole positions (m, frame fg) and unit directions
    positions: Array
    directions: Array
    moments: Array  # (N, 2K), A m^2; for every emitter its real part, then its imaginary part

    @classmethod
    def of(cls, positions: AnyArray, directions: AnyArray, moments: AnyArray) -> 'RealField':
        """Lay out dipoles with complex magnitudes, shape (N, K).

        Raises `TrackingError` when a value is not finite.
        """
        r = np.ascontiguousarray(positions, dtype=np.float64)
        u = np.ascontiguousarray(directions, dtype=np.float64)
        m = np.ascontiguousarray(moments, dtype=np.complex128)
        if not (np.isfinite(r).all() and np.isfinite(u).all() and np.isfinite(m).all()):
            raise TrackingError('a field model must be finite')
        return cls(r, u, m.view(np.float64))

    @cached_property
    def columns(self) -> Array:
        """Return coordinates of the positions and of the directions in rows, shape (6, N)."""
        return dipole_rows(self.positions, self.directions)

    @property
    def emitters(self) -> int:
        """Return the number K of emitters."""
        return int(self.moments.shape[1]) // 2


class CoilSolution(NamedTuple):
    """States where a coil's solve ended."""

    position: Array  # (3,), m, frame fg
    axis: Array  # (3,), unit sensitive axis
    chi2: float  # Sum of squared whitened residuals
    # (6, 6), ``J^T J`` of the whitened residuals by position (per m) and free axis vector
    normal: Array
    residual: Array  # (2K,), measured minus modelled flux, T; real and imaginary part by turns
    evaluations: int  # Field evaluations used
    converged: bool  # Whether the last step was negligible
    # Variance that is expected there over the typical one, by which the above are weighed
    growth: float = 1.0


def whitening_of(sigma: Array) -> Array:
    """Return the matrix, 1/T, that turns a flux residual into one of unit covariance.

    It is the diagonal alone, shape (1, 2K), from the standard deviation ``sigma`` (2K,) of each
    flux component, T. Raises `TrackingError` when a sigma is not positive and finite.
    """
    deviations = np.asarray(sigma, dtype=np.float64)
    if not (np.isfinite(deviations).all() and (deviations > 0).all()):
        raise TrackingError('flux standard deviations must be positive and finite')
    return np.ascontiguousarray(1.0 / deviations[None, :])


def solve_coil(
    field: RealField,
    flux: Array,
    whitening: Array,
    position: AnyArray,
    axis: AnyArray,
    low: Array,
    high: Array,
    length_m: float = 0.0,
) -> CoilSolution:
    """Fit a coil's pose from a start near it.

    ``flux`` (2K,) in T has real and imaginary part by turns; ``whitening`` is from `whitening_of`,
    or a whole matrix (2K, 2K), 1/T. The start is a ``position`` (m, frame fg) and a unit ``axis``;
    the position does not leave the box from ``low`` to ``high``, m. A ``length_m`` of 0 is a point
    sensor. Raises `TrackingError` when ``flux`` doesn't have two values for every emitter.
    """
    width = field.moments.shape[1]
    if flux.shape != (width,) or whitening.shape[1:] != (width,):
        raise TrackingError(
            f'the model has {width} flux components, got flux {flux.shape} and whitening '
            f'{whitening.shape}'
        )
    r, n = np.array(position, dtype=np.float64), np.array(axis, dtype=np.float64)
    normal, residual, found = np.empty((6, 6)), np.empty(width), np.empty((1, 3))
    descend(
        r[None], n[None], np.array([length_m]), flux[None], whitening[None], field.columns,
        field.moments, low, high, MAX_EVALUATIONS, normal[None], residual[None], found,
    )  # fmt: skip
    chi2, used, converged = found[0].tolist()
    return CoilSolution(r, n, chi2, normal, residual, int(used), bool(converged))


ROLL_VARIANCE = math.pi**2 / 3.0
"""Variance (rad^2) of an angle that may be anything in +-pi."""

UNKNOWN_VARIANCE = 1.0
"""Upper bound (m^2 or rad^2) of a variance along a direction that the fluxes don't determine."""


@lru_cache(maxsize=256)
def chi2_limit(degrees_of_freedom: int, probability: float) -> float:
    """Return chi-square that noise alone exceeds with the given probability."""
    return float(chdtri(max(degrees_of_freedom, 1), probability))


SMALLEST_PIVOT = 1e-9
"""Pivot of a scaled information matrix from which on its factor is used; with a smaller one
rounding is felt, and what the fluxes hardly determine is looked for among the eigenvectors."""


@kernel
def bounded_inverse(information):  # type: ignore[no-untyped-def]
    """Return the covariance of a symmetric, positive semidefinite information matrix.

    Directions that it hardly determines get `UNKNOWN_VARIANCE`.
    """
    n = information.shape[0]
    scale, scaled, covariance = np.empty(n), np.empty((n, n)), np.empty((n, n))
    factor, unit, column = np.empty((n, n)), np.zeros(n), np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(information[i, i], 1e-30))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * scale[i] * scale[j]
    is_sure = True
    for j in range(n):
        unit[j] = 1.0
        is_sure &= damped_step(scaled, unit, 0.0, factor, column)
        is_sure &= factor[j, j] * factor[j, j] > SMALLEST_PIVOT
        unit[j] = 0.0
        for i in range(j, n):
            covariance[i, j] = covariance[j, i] = column[i]
    if not is_sure and not np.isfinite(scaled).all():  # at a dipole itself: nothing is known
        return UNKNOWN_VARIANCE * np.eye(n)
    if not is_sure:
        values, vectors = np.linalg.eigh(scaled)
        for i in range(n):
            for j in range(n):
                covariance[i, j] = 0.0
                for k in range(n):
                    part = vectors[i, k] * vectors[j, k]
                    covariance[i, j] += part / max(values[k], 1e-14)
    for i in range(n):
        for j in range(n):
            covariance[i, j] *= scale[i] * scale[j]
    for i in range(n):
        if covariance[i, i] > UNKNOWN_VARIANCE:
            shrink = math.sqrt(UNKNOWN_VARIANCE / covariance[i, i])
            for j in range(n):
                covariance[i, j] *= shrink
            for j in range(n):
                covariance[j, i] *= shrink
    return covariance


@kernel
def coil_covariance(normal, axis, roll_variance):  # type: ignore[no-untyped-def]
    """Return the covariance (6, 6) of a coil's position and rotation vector, both in fg, m and
    rad.

    ``normal`` (6, 6) is ``J^T J`` of the whitened residuals by position (per m) and free axis
    vector; ``roll_variance``, rad^2, is given to the rotation about the axis.
    """
    t = np.empty((2, 3))
    fill_tangent(axis, t)
    # A turn w moves the axis by w x n: about t[0] by -t[1], about t[1] by t[0]. So of the six
    # columns of the normal matrix five are left, and two of them become three of a turn.
    half, information = np.empty((5, 6)), np.empty((5, 5))
    for j in range(6):
        for i in range(3):
            half[i, j] = normal[i, j]
        half[3, j] = half[4, j] = 0.0
        for c in range(3):
            half[3, j] -= t[1, c] * normal[3 + c, j]
            half[4, j] += t[0, c] * normal[3 + c, j]
    for i in range(5):
        for j in range(3):
            information[i, j] = half[i, j]
        information[i, 3] = information[i, 4] = 0.0
        for c in range(3):
            information[i, 3] -= half[i, 3 + c] * t[1, c]
            information[i, 4] += half[i, 3 + c] * t[0, c]
    inner, covariance = bounded_inverse(information), np.empty((6, 6))
    for i in range(3):
        for j in range(3):
            covariance[i, j] = inner[i, j]
            turned = inner[i, 3] * t[0, j] + inner[i, 4] * t[1, j]
            covariance[i, 3 + j] = covariance[3 + j, i] = turned
            turns = roll_variance * axis[i] * axis[j]
            for k in range(2):
                for m in range(2):
                    turns += t[k, i] * inner[3 + k, 3 + m] * t[m, j]
            covariance[3 + i, 3 + j] = turns
    return covariance


COMMON_GAIN = 0.01
"""Standard deviation of a gain that all coils of a tool have in common where it has changed, as by
one amplifier or by the emitters' supply. Nine coils with eight emitters know it to 3e-4 in one
frame at 0.25 m."""
GAIN_CHANGES = 0.01
"""Probability that it has changed, before the coils say anything: as of a coil by itself
(`pose_checks.FAILS_ALONE`). Where no reading tells, it may be off by a thousandth then: a tracker
of measured/ilemt changed by 0.07 % from one recording to the next, most do by less."""
LEAST_GAIN = 5e-4
"""Common gain that nobody reckons with: it moves no pose by 0.1 mm, and its noise is 1e-4."""


@kernel
def add_gain(covariance, normal, axis, gain, misfit):  # type: ignore[no-untyped-def]
    """Add to a coil's covariance (6, 6), in place, what a gain with a deviation of ``gain`` does.

    A coil alone takes a gain for another distance. With the free axis vector n that the normal
    matrix has, see `coil_covariance`, a gain is a change of n along itself. Where no body tells
    the gain, NaN, it is what the coil's own readings leave of the prior, as in
    `rigid.BodySolution.gain`, all of their ``misfit`` (chi-square beyond its mean) being its.
    """
    own, pull, moved = coil_covariance(normal, axis, 0.0), np.zeros(6), np.zeros(6)
    known = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            pull[i] += normal[i, 3 + c] * axis[c]
            pull[3 + i] += axis[j] * normal[3 + k, 3 + c] * axis[c]
            pull[3 + i] -= axis[k] * normal[3 + j, 3 + c] * axis[c]
            known += axis[i] * normal[3 + i, 3 + c] * axis[c]
    for i in range(6):
        for j in range(6):
            moved[i] += own[i, j] * pull[j]
    if math.isnan(gain):
        for i in range(6):
            known -= pull[i] * moved[i]
        known = max(known, 0.0) + COMMON_GAIN**-2
        gain = math.sqrt(max((1.0 + misfit) / known - LEAST_GAIN**2, 0.0))
    for i in range(6):
        for j in range(6):
            covariance[i, j] += gain * moved[i] * gain * moved[j]


@kernel
def add_motion(covariance, position, next_position, axes, next_axes, share):  # type: ignore[no-untyped-def]
    """Add to a pose's covariance (6, 6), in place, a part of its last motion as an error.

    ``axes`` and ``next_axes`` hold all axes of a body, or that of a coil, in columns: (3, 3) or
    (3, 1). ``share`` is the error's standard deviation in units of the motion.
    """
    move = np.zeros(6)
    # Each axis n turns by w x n; the sum of n x (w x n) over three axes is 2 w, over one it is w.
    part = share / (2.0 if axes.shape[1] == 3 else 1.0)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        move[i] = share * (next_position[i] - position[i])
        for c in range(axes.shape[1]):
            turn = axes[j, c] * next_axes[k, c] - axes[k, c] * next_axes[j, c]
            move[3 + i] += part * turn
    for i in range(6):
        for j in range(6):
            covariance[i, j] += move[i] * move[j]
