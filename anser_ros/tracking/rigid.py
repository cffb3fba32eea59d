"""Solves for the 6-DoF pose of a rigid tool from all of its coils at once.

The rotation moves by a rotation vector in fg, R <- exp([w]) R, so no attitude is singular. Model
errors are common to all coils; they enter as a low-rank part of the residuals' covariance
(Woodbury's identity), so coils that share an error don't count as independent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.physics.angles import nearest_rotation
from anser_ros.physics.dipole import flux_jacobian
from anser_ros.physics.sensor import along_each_axis
from anser_ros.tracking.body_descent import descend_body, fill_common
from anser_ros.tracking.seed import SeedGrid
from anser_ros.tracking.solve import Array, RealField

MAX_EVALUATIONS = 30
"""Evaluations of the residuals after which a descent is given up as not converged. Good starts
need a few; the bound keeps the time of a frame limited when the fluxes fit no pose."""
GRID_STARTS = 12
"""Starts from the grid of a body whose coils have no poses of their own. Fewer miss the right
valley more often; each more costs a descent of all coils."""
PARALLEL = 0.05
"""Sine of the angle between axes below which all coils of a tool count as parallel."""


@dataclass(frozen=True)
class BodyCoils:
    """Holds a tool's coils in its own frame: offsets (S, 3) m, unit axes (S, 3), lengths (S,) m.

    ``changes`` (G, S) are relative changes of gains that several coils may have in common, one
    standard deviation each; None where there are none.
    """

    offsets: Array
    axes: Array
    lengths: Array
    changes: Array | None = None

    @cached_property
    def observable(self) -> bool:
        """Return whether two coils are not parallel, so that all six degrees of freedom show."""
        return len(self.axes) > 1 and bool(
            np.linalg.svd(self.axes, compute_uv=False)[1] > PARALLEL
        )

    @cached_property
    def reach(self) -> float:
        """Return the largest distance of a coil from the tool's origin, m."""
        return float(np.linalg.norm(self.offsets, axis=1).max())

    def subset(self, keep: NDArray[np.generic]) -> 'BodyCoils':
        """Return the coils of a mask or of ascending indices; all of them are these coils
        themselves.
        """
        if len(self.offsets[keep]) == len(self.offsets):
            return self
        return BodyCoils(
            np.ascontiguousarray(self.offsets[keep]),
            np.ascontiguousarray(self.axes[keep]),
            np.ascontiguousarray(self.lengths[keep]),
            None if self.changes is None else np.ascontiguousarray(self.changes[:, keep]),
        )

    def gain_errors(self, flux: Array) -> Array:
        """Return what the changes of gains make of fluxes (S, 2K): (S, G, 2K), T."""
        if self.changes is None:
            return np.zeros((len(flux), 0, flux.shape[1]))
        return np.asarray(self.changes.T[:, :, None] * flux[:, None, :])


@dataclass(frozen=True)
class BodySolution:
    """States where a rigid tool's solve ended."""

    position: Array  # (3,), body origin, m, frame fg
    rotation: Array  # (3, 3), takes body vectors to fg
    chi2: float  # Squared residual in units of its covariance
    information: Array  # (6, 6), inverse covariance of (position, rotation vector), both in fg
    residual: Array  # (S, 2K), measured minus modelled flux, T
    coil_chi2: Array  # (S,), each coil's squared residual in units of its own noise
    evaluations: int
    converged: bool


def common_factor(modes: Array, inverse_sigma: Array) -> Array:
    """Return E (R, S 2K) with ``(I + D^T D)^-1 = I - E^T E`` for whitened modes D.

    ``modes`` (S, R, 2K) are flux errors of one standard deviation each that several coils share,
    T; ``inverse_sigma`` (S, 2K) is in 1/T.

    Raises
    ------
    TrackingError
        When the modes are not finite.
    """
    common = np.empty((modes.shape[1], inverse_sigma.size))
    if not fill_common(modes, inverse_sigma, common):
        raise TrackingError('the model covariance must be finite')
    return common


def solve_body(
    field: RealField,
    coils: BodyCoils,
    flux: Array,
    inverse_sigma: Array,
    common: Array,
    position: NDArray[np.generic],
    rotation: NDArray[np.generic],
    low: Array,
    high: Array,
) -> BodySolution:
    """Fit a rigid tool's pose from a start near it.

    ``flux`` (S, 2K) in T has real and imaginary part by turns, ``inverse_sigma`` (S, 2K) is in
    1/T; ``common`` is from `common_factor`, without a row for a model without uncertainty. The
    body's origin does not leave the box from ``low`` to ``high``, m.

    Raises
    ------
    TrackingError
        When shapes don't fit.
    """
    count, width = len(coils.offsets), field.moments.shape[1]
    if flux.shape != (count, width) or inverse_sigma.shape != flux.shape:
        raise TrackingError(f'{count} coils and {width} components, got flux {flux.shape}')

    r, turn = np.array(position, dtype=np.float64), np.array(rotation, dtype=np.float64)
    residual, white = np.empty((count, width)), np.empty((7, count * width))
    information = np.empty((6, 6))
    chi2, used, converged = descend_body(
        r, turn, coils.offsets, coils.axes, coils.lengths, flux, inverse_sigma, common,
        field.columns, field.moments, low, high, MAX_EVALUATIONS, residual, white,
        information,
    )  # fmt: skip
    coil_chi2 = (white[0].reshape(count, width) ** 2).sum(axis=1)
    return BodySolution(r, turn, chi2, information, residual, coil_chi2, used, converged)


def start_from_coils(
    coils: BodyCoils, positions: Array, axes: Array, weights: Array
) -> tuple[Array, Array] | None:
    """Return the pose of a body from its coils' own 5-DoF poses (Wahba's problem).

    ``coils`` are those that have a pose: ``positions`` (m) and unit ``axes`` (S, 3) in fg,
    ``weights`` (S,) by how much each is trusted. None when these coils don't fix the rotation.
    """
    if len(axes) == 0:
        return None
    share = weights / weights.sum()
    here, there = share @ coils.offsets, share @ positions
    matrix = (axes * share[:, None]).T @ coils.axes
    # A lever arm of 3 cm known to 1 mm tells directions about as well as an axis does.
    matrix += ((positions - there) * share[:, None]).T @ (coils.offsets - here) / 0.03**2
    if np.linalg.svd(matrix, compute_uv=False)[1] < 1e-3:
        return None
    rotation = nearest_rotation(matrix)
    return there - rotation @ here, rotation


def start_from_grid(
    grid: SeedGrid, field: RealField, coils: BodyCoils, flux: Array
) -> list[tuple[Array, Array]]:
    """Return starts for a body whose single coils have no poses (few emitters, many axes).

    At every grid point the emitters' fields are turned to fit the fluxes (S, 2K), T, of all coils
    at once, the lever arms neglected; the poses with the least misfit come first.
    """
    total = len(grid.points)
    complex_moments = field.moments.view(np.complex128)
    points, axes = along_each_axis(grid.points)
    model, _, _ = flux_jacobian(
        points, axes, None, field.positions, field.directions, complex_moments
    )
    fields = model.view(np.float64).reshape(total, 3, -1)
    measured = coils.axes.T @ flux
    rotations = nearest_rotation(np.einsum('gik,jk->gij', fields, measured))
    predicted = np.einsum('sj,gij,gik->gsk', coils.axes, rotations, fields, optimize=True)
    misfit = ((flux - predicted) ** 2).sum(axis=(1, 2))
    order: Sequence[int] = np.argsort(misfit, kind='stable')[: 8 * GRID_STARTS].tolist()
    chosen: list[int] = []
    for index in order:
        apart = [np.linalg.norm(grid.points[index] - grid.points[c]) for c in chosen]
        if len(chosen) < GRID_STARTS and all(distance > grid.spacing_m for distance in apart):
            chosen.append(index)
    return [
        (grid.points[i] - rotations[i] @ coils.offsets.mean(axis=0), rotations[i]) for i in chosen
    ]
