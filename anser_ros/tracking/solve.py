"""Solves for a coil's pose from complex fluxes: damped least squares with the dipoles' own
gradient.

The unknowns are the position and the unit axis; the axis moves by a two-parameter step in its
tangent plane, so that no direction is singular. In-phase and quadrature parts are fitted together,
each divided by its standard deviation: the residual has no unit, and a step is small when it is
small against the pose's own uncertainty. The damping is Marquardt's (Nocedal and Wright, Numerical
Optimization, section 10.3); each trial costs one evaluation of the field and of its gradient.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.tracking.descent import descend

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MAX_EVALUATIONS = 40
"""Evaluations of the residuals after which a descent is given up as not converged. Good starts
need a few; the bound keeps the time of a frame limited when the fluxes fit no pose."""


@dataclass(frozen=True)
class RealField:
    """Holds a field model laid out for the kernels."""

    # positions, directions: (N, 3), dipole positions (m, frame fg) and unit directions
    positions: Array
    directions: Array
    moments: Array  # (N, 2K), A m^2; for every emitter its real part, then its imaginary part

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
            raise TrackingError(f'{r.shape[0]} dipoles cannot have moments of shape {m.shape}')
        if not (np.isfinite(r).all() and np.isfinite(u).all() and np.isfinite(m).all()):
            raise TrackingError('a field model must be finite')
        return cls(r, u, m.view(np.float64))

    @cached_property
    def columns(self) -> Array:
        """Return coordinates of the positions and of the directions in rows, shape (6, N)."""
        return np.ascontiguousarray(np.concatenate([self.positions, self.directions], axis=1).T)

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


def whitening_of(sigma: Array) -> Array:
    """Return the matrix, 1/T, that turns a flux residual into one of unit covariance.

    It is the diagonal alone, shape (1, 2K), from the standard deviation ``sigma`` (2K,) of each
    flux component, T.

    Raises
    ------
    TrackingError
        When a sigma is not positive and finite.
    """
    deviations = np.asarray(sigma, dtype=np.float64)
    if not (np.isfinite(deviations).all() and (deviations > 0).all()):
        raise TrackingError('flux standard deviations must be positive and finite')
    return np.ascontiguousarray(1.0 / deviations[None, :])


def solve_coil(
    field: RealField,
    flux: Array,
    whitening: Array,
    position: NDArray[np.generic],
    axis: NDArray[np.generic],
    low: Array,
    high: Array,
    length_m: float = 0.0,
) -> CoilSolution:
    """Fit a coil's pose from a start near it.

    ``flux`` (2K,) in T has real and imaginary part by turns; ``whitening`` is from `whitening_of`,
    or a whole matrix (2K, 2K), 1/T. The start is a ``position`` (m, frame fg) and a unit ``axis``;
    the position does not leave the box from ``low`` to ``high``, m. A ``length_m`` of 0 is a point
    sensor.

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
        r, n, length_m, flux, whitening, field.columns, field.moments, low, high,
        MAX_EVALUATIONS, normal, residual,
    )  # fmt: skip
    return CoilSolution(r, n, chi2, normal, residual, used, converged)
