"""Solves for the 6-DoF pose of a rigid tool from all of its coils at once.

The steps: errors that coils share become a low-rank part of the residuals' covariance (Woodbury's
identity); every coil's flux and its slopes; damped steps of translation and rotation vector in fg,
R <- exp([w]) R, so that no attitude is singular; starts from the coils' own poses, or from the
grid.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array
from anser_ros.errors import TrackingError
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.physics.dipole import dipole_field, fill_coil_basis, fill_flux_basis
from anser_ros.physics.rotations import nearest_rotation
from anser_ros.tracking.descent import (
    CONVERGED_CHI2,
    FIRST_DAMPING,
    LEAST_RAISED,
    TRUSTED_CHI2,
    damped_step,
    limit_step,
)
from anser_ros.tracking.seed import SeedGrid
from anser_ros.tracking.solve import (
    COMMON_GAIN,
    GAIN_CHANGES,
    LEAST_GAIN,
    RealField,
    bounded_inverse,
)
from anser_ros.tracking.solve_context import NOT_FINITE, ModelArrays, growth_at


@inlined
def _look(  # type: ignore[no-untyped-def]
    pose, offsets, axes, lengths, flux, inverse_sigma, common, dipoles, moments, basis
):  # fmt: skip
    """Fill what `descend_body` keeps of a pose, beginning with position and rotation.

    It is the residual (S, 2K), the whitened residual (row 0) and whitened derivatives by
    translation and turn, both in fg, the first seven of (8, S 2K), and the normal equations (6, 6)
    and (6,). Returns chi-square. ``basis`` (S, 7, N) is written over.
    """
    position, rotation, residual, white, information, gradient = pose
    coils, width = flux.shape
    arms, turned = np.dot(offsets, rotation.T), np.dot(axes, rotation.T)
    places = np.empty((coils, 3))
    for s in range(coils):
        for i in range(3):
            places[s, i] = position[i] + arms[s, i]
    fill_coil_basis(places, turned, lengths, dipoles, basis)
    model = np.dot(basis.reshape(7 * coils, dipoles.shape[1]), moments)
    for s in range(coils):
        m = model[7 * s : 7 * s + 7]
        for k in range(width):
            w, column = inverse_sigma[k], s * width + k
            residual[s, k] = flux[s, k] - m[0, k]
            white[0, column] = w * residual[s, k]
            for i in range(3):
                j, n = (i + 1) % 3, (i + 2) % 3
                turn = arms[s, j] * m[1 + n, k] - arms[s, n] * m[1 + j, k]
                turn += turned[s, j] * m[4 + n, k] - turned[s, n] * m[4 + j, k]
                white[1 + i, column] = w * m[1 + i, k]
                white[4 + i, column] = w * turn
    products, shared = np.dot(white, white.T), np.dot(white, common.T)
    shared = np.dot(shared, shared.T)
    for i in range(6):
        gradient[i] = products[1 + i, 0] - shared[1 + i, 0]
        for j in range(6):
            information[i, j] = products[1 + i, 1 + j] - shared[1 + i, 1 + j]
    return products[0, 0] - shared[0, 0]


@inlined
def _turned(x, y, z, rotation, new_rotation):  # type: ignore[no-untyped-def]
    """Write a rotation that is turned by a vector besides, rad, in fg."""
    square, vector, turn = x * x + y * y + z * z, np.empty(3), np.empty((3, 3))
    vector[0], vector[1], vector[2] = x, y, z
    angle = math.sqrt(square)
    if angle < 1e-4:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        turn[i, i] = 1.0 - b * (vector[j] * vector[j] + vector[k] * vector[k])
        both = b * vector[i] * vector[j]
        turn[i, j], turn[j, i] = both - a * vector[k], both + a * vector[k]
    new = np.dot(turn, rotation)
    square_of_new = np.dot(new, new.T)
    rounded = np.dot(square_of_new, new)
    for i in range(3):
        for j in range(3):
            # One step towards the nearest rotation takes off what rounding has added.
            new_rotation[i, j] = 1.5 * new[i, j] - 0.5 * rounded[i, j]


@inlined
def _advance(  # type: ignore[no-untyped-def]
    position, rotation, information, gradient, step, low, high, new_position, new_rotation
):  # fmt: skip
    """Take a step: the position stays in the box, the rotation stays orthonormal.

    Returns the fall of chi-square that the local model promises for it.
    """
    promised = 0.0
    for i in range(6):
        row = 0.0
        for j in range(6):
            row += information[i, j] * step[j]
        promised += step[i] * (2.0 * gradient[i] - row)
    for i in range(3):
        new_position[i] = min(max(position[i] + step[i], low[i]), high[i])
    _turned(step[3], step[4], step[5], rotation, new_rotation)
    return promised


@kernel
def descend_body(  # type: ignore[no-untyped-def]
    position, rotation, offsets, axes, lengths, flux, inverse_sigma, common, dipoles, moments,
    low, high, budget,
):  # fmt: skip
    """Find the least chi-square near a pose, whose arrays are written over.

    Returns chi-square, whether it converged; position and rotation; residual; whitened residual,
    derivatives and flux (8, S 2K); and information, as `_look` fills them at its last pose.
    """
    basis, size = np.empty((flux.shape[0], 7, dipoles.shape[1])), flux.size
    step, factor = np.empty(6), np.empty((6, 6))
    pose = (
        np.empty(3), np.empty((3, 3)), np.empty(flux.shape), np.empty((8, size)),
        np.empty((6, 6)), np.empty(6),
    )  # fmt: skip
    trial = (
        position, rotation, np.empty(flux.shape), np.empty((8, size)), np.empty((6, 6)),
        np.empty(6),
    )  # fmt: skip
    for s in range(flux.shape[0]):
        for k in range(flux.shape[1]):
            white = inverse_sigma[k] * flux[s, k]
            pose[3][7, s * flux.shape[1] + k] = trial[3][7, s * flux.shape[1] + k] = white
    chi2, promised, used, damping, converged = 0.0, 0.0, 0, FIRST_DAMPING, False
    while True:
        trial_chi2 = _look(
            trial, offsets, axes, lengths, flux, inverse_sigma, common, dipoles, moments, basis
        )
        used += 1
        if used == 1 or trial_chi2 <= chi2:
            if used > 1:
                fall = chi2 - trial_chi2
                converged = fall < CONVERGED_CHI2 + 1e-9 * chi2
                damping *= 0.1 if fall > 0.5 * promised else 0.5
            chi2 = trial_chi2
            pose, trial = trial, pose
        else:
            damping = max(5.0 * damping, LEAST_RAISED)
        place, has_step = pose[:2], False
        while used < budget and not (converged or has_step) and damping < 1e10:
            has_step = damped_step(pose[4], pose[5], damping, factor, step)
            if not has_step:
                damping = max(10.0 * damping, LEAST_RAISED)
        if not has_step:
            break
        short = limit_step(step)
        promised = _advance(
            pose[0], pose[1], pose[4], pose[5], step, low, high, trial[0], trial[1]
        )
        negligible = promised < CONVERGED_CHI2 + 1e-9 * chi2
        if negligible or (short and promised < TRUSTED_CHI2):
            chi2 -= promised
            converged, place = True, trial[:2]
            break
    return chi2, converged, place[0], place[1], pose[2], pose[3], pose[4]


@kernel
def carried_on(position, rotation, old_position, old_rotation, steps):  # type: ignore[no-untyped-def]
    """Return position and rotation after so many more steps like that from the old ones."""
    moved, turn, turned = np.empty(3), np.dot(rotation, old_rotation.T), np.empty((3, 3))
    x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    sine, cosine = math.sqrt(x * x + y * y + z * z), turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0
    part = steps * math.atan2(sine, cosine) / sine if sine > 0.0 else 0.0
    for i in range(3):
        moved[i] = position[i] + steps * (position[i] - old_position[i])
    _turned(part * x, part * y, part * z, rotation, turned)
    return moved, turned


@kernel
def step_to_coils(  # type: ignore[no-untyped-def]
    position, rotation, offsets, axes, coil_positions, coil_axes, normals, low, high
):  # fmt: skip
    """Return the position and rotation nearby where single coils' own poses agree best.

    ``normals`` (S, 6, 6) weigh each coil's position and free axis vector. It is the first step of
    the descent, from the slopes that the coils' own solves have found already.
    """
    slopes, apart = np.zeros((6, 6)), np.empty(6)
    normal, gradient = np.zeros((6, 6)), np.zeros(6)
    arms, turned = np.dot(offsets, rotation.T), np.dot(axes, rotation.T)
    for i in range(3):
        slopes[i, i] = 1.0
    for s in range(offsets.shape[0]):
        for i in range(3):
            j, n = (i + 1) % 3, (i + 2) % 3
            apart[i] = coil_positions[s, i] - position[i] - arms[s, i]
            apart[3 + i] = coil_axes[s, i] - turned[s, i]
            # A turn w moves a vector v by w x v. The columns are those of the coil's pose.
            slopes[3 + j, i], slopes[3 + n, i] = arms[s, n], -arms[s, j]
            slopes[3 + j, 3 + i], slopes[3 + n, 3 + i] = turned[s, n], -turned[s, j]
        weighted = np.dot(slopes, normals[s])
        product = np.dot(weighted, slopes.T)
        for i in range(6):
            for j in range(6):
                normal[i, j] += product[i, j]
                gradient[i] += weighted[i, j] * apart[j]
    step, factor = np.empty(6), np.empty((6, 6))
    new_position, new_rotation = np.empty(3), np.empty((3, 3))
    if not damped_step(normal, gradient, FIRST_DAMPING, factor, step):
        return position, rotation
    limit_step(step)
    _advance(position, rotation, normal, gradient, step, low, high, new_position, new_rotation)
    return new_position, new_rotation


MAX_EVALUATIONS = 30
"""Evaluations after which a descent is given up: good starts need a few, and a frame is short."""
GRID_STARTS = 12
"""Starts from the grid of a body whose coils have no poses; fewer miss the right valley more."""
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

    @staticmethod
    def single(length_m: float) -> 'BodyCoils':
        """Return a coil by itself, along z."""
        return BodyCoils(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.array([length_m]))

    @cached_property
    def observable(self) -> bool:
        """Return whether two coils are not parallel, so that all six degrees of freedom show."""
        return len(self.axes) > 1 and bool(
            np.linalg.svd(self.axes, compute_uv=False)[1] > PARALLEL
        )

    @cached_property
    def middle(self) -> Array:
        """Return the mean of the offsets, (3,), m."""
        return np.asarray(self.offsets.mean(axis=0))

    def subset(self, keep: NDArray[np.generic]) -> 'BodyCoils':
        """Return the coils of a mask or of ascending indices; all of them are these coils
        themselves.
        """
        if (keep.sum() if keep.dtype == np.bool_ else len(keep)) == len(self.offsets):
            return self
        return BodyCoils(
            np.ascontiguousarray(self.offsets[keep]),
            np.ascontiguousarray(self.axes[keep]),
            np.ascontiguousarray(self.lengths[keep]),
            None if self.changes is None else np.ascontiguousarray(self.changes[:, keep]),
        )

    @cached_property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Return all of it for the compiled steps; ``changes`` are (0, S) where there are none."""
        none = np.empty((0, len(self.axes)))
        changes = none if self.changes is None else self.changes
        return self.offsets, self.axes, self.lengths, changes


class BodySolution(NamedTuple):
    """States where a rigid tool's solve ended, and how well that is known."""

    position: Array  # (3,), body origin, m, frame fg
    rotation: Array  # (3, 3), takes body vectors to fg
    chi2: float  # Squared residual in units of its covariance
    information: Array  # (6, 6), inverse covariance of (position, rotation vector), both in fg
    residual: Array  # (S, 2K), measured minus modelled flux, T
    converged: bool
    # (8, S 2K), whitened: residual, derivatives as in `_look`, flux
    rows: Array
    coil_chi2: Array  # (S,), each coil's squared residual in units of its own noise
    whitened: Array  # (S 2K,), residuals without what coils share: noise of one each
    covariance: Array  # (6, 6), of position and rotation vector, see `bounded_inverse`
    # What a gain of all coils may be off by, and what a gain does to the pose (6,), m and rad
    gain: float
    carried: Array
    growth: float  # variance that is expected there over the typical one


@kernel
def weigh(rows, common, information, coils):  # type: ignore[no-untyped-def]
    """Return the last five items of `BodySolution`, of so many coils.

    ``common`` is from `fill_common`. What the gain may be off by is the root of the mean square
    of its posterior beyond `LEAST_GAIN`: it has changed with a probability of `GAIN_CHANGES`, then
    by `COMMON_GAIN`.
    """
    shared = np.dot(rows, common.T)
    products = np.dot(rows, rows.T) - np.dot(shared, shared.T)
    whitened, coil_chi2 = rows[0] - np.dot(shared[0], common), np.zeros(coils)
    width = rows.shape[1] // coils
    for i in range(rows.shape[1]):
        coil_chi2[i // width] += rows[0, i] ** 2
    covariance, carried = bounded_inverse(information), np.zeros(6)
    told, score = products[7, 7], products[7, 0]
    for i in range(6):
        for j in range(6):
            carried[i] += covariance[i, j] * products[1 + j, 7]
    for i in range(6):
        told -= products[7, 1 + i] * carried[i]
        for j in range(6):
            score -= products[7, 1 + i] * covariance[i, j] * products[1 + j, 0]
    variance = 1.0 / (max(told, 0.0) + COMMON_GAIN**-2)
    odds = GAIN_CHANGES / (1.0 - GAIN_CHANGES) * math.sqrt(variance) / COMMON_GAIN
    changed = 1.0 / (1.0 + math.exp(-0.5 * variance * score**2) / odds)
    square = changed * ((variance * score) ** 2 + variance) - LEAST_GAIN**2
    return coil_chi2, whitened, covariance, math.sqrt(max(square, 0.0)), carried


@kernel
def _factor(out):  # type: ignore[no-untyped-def]
    """Turn modes D (R, n) into E, see `fill_common`; return False where they are not finite."""
    factor = np.dot(out, out.T)
    for i in range(out.shape[0]):
        for j in range(i + 1):
            total = factor[i, j] + (i == j)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if not math.isfinite(total):
                return False
            factor[i, j] = total / factor[j, j] if j < i else math.sqrt(total)
        for k in range(i):
            for m in range(out.shape[1]):
                out[i, m] -= factor[i, k] * out[k, m]
        for m in range(out.shape[1]):
            out[i, m] /= factor[i, i]
    return True


@kernel
def fill_common(  # type: ignore[no-untyped-def]
    position, rotation, offsets, axes, lengths, changes, flux, dipoles, modes, sigma, strengths,
    out,
):  # fmt: skip
    """Write E (R, S 2K), ``(I + D^T D)^-1 = I - E^T E`` with whitened modes D of a body at a pose:
    errors of one standard deviation each of the model's moments, of gains that coils have in
    common, and of the emitters' strengths, in this order.

    A body learns how far each mode goes from what its coils differ by: those of places 6 mm
    aside, where a coil was before, make poses by a drawing wrong by 3.5 of their sigmas. The
    arguments are those of `BodyCoils` and `fill_model_errors`, ``flux`` (S, 2K), T. Returns False
    where an error is not finite.
    """
    coils, width = flux.shape
    places, turned = np.dot(offsets, rotation.T), np.dot(axes, rotation.T)
    places += position
    basis, count = np.empty((coils, dipoles.shape[1])), modes.shape[1] // width
    fill_flux_basis(places, turned, lengths, dipoles, basis)
    made, gains = np.dot(basis, modes), count + changes.shape[0]
    for s in range(coils):
        for k in range(width):
            column, weight = s * width + k, 1.0 / sigma[k]
            for r in range(count):
                out[r, column] = weight * made[s, r * width + k]
            for r in range(changes.shape[0]):
                out[count + r, column] = weight * changes[r, s] * flux[s, k]
            real, other, sign = k - k % 2, k + 1 - 2 * (k % 2), 2.0 * (k % 2) - 1.0
            for r in range(strengths.shape[1]):
                a, b = strengths[real, r], sign * strengths[real + 1, r]
                out[gains + r, column] = weight * (flux[s, k] * a + flux[s, other] * b)
    return _factor(out)


@inlined
def reach_of(offsets):  # type: ignore[no-untyped-def]
    """Return the largest distance of coils (S, 3) from the tool's origin, m."""
    most = 0.0
    for s in range(offsets.shape[0]):
        most = max(most, offsets[s, 0] ** 2 + offsets[s, 1] ** 2 + offsets[s, 2] ** 2)
    return math.sqrt(most)


@kernel
def solve_near(position, rotation, coils, flux, model):  # type: ignore[no-untyped-def]
    """Return whether the model's error is finite, and the `BodySolution` from a start near it.

    ``coils`` are `BodyCoils.arrays`, ``flux`` (S, 2K), T, ``model`` is `SolveContext.arrays`.
    """
    offsets, axes, lengths, changes = coils
    count, width = flux.shape
    rank = model.modes.shape[1] // width + changes.shape[0] + model.strengths.shape[1]
    common = np.empty((rank, flux.size))
    is_finite = fill_common(
        position, rotation, offsets, axes, lengths, changes, flux, model.uncertain, model.modes,
        model.sigma, model.strengths, common,
    )  # fmt: skip
    reach, budget = reach_of(offsets), MAX_EVALUATIONS if is_finite else 1
    chi2, converged, place, turn, residual, white, information = descend_body(
        position.copy(), rotation.copy(), offsets, axes, lengths, flux, 1.0 / model.sigma, common,
        model.columns, model.moments, model.low - reach, model.high + reach, budget,
    )  # fmt: skip
    growth = growth_at(place, model)
    chi2, information, white = chi2 / growth, information / growth, white / math.sqrt(growth)
    coil_chi2, whitened, covariance, gain, carried = weigh(white, common, information, count)
    return is_finite, BodySolution(
        place, turn, chi2, information, residual, converged, white, coil_chi2, whitened,
        covariance, gain, carried, growth,
    )  # fmt: skip


def solve_body(
    coils: BodyCoils, flux: Array, model: ModelArrays, position: Array, rotation: Array
) -> BodySolution:
    """Fit a rigid tool's pose from a start near it.

    ``flux`` (S, 2K) in T has real and imaginary part by turns. The body's origin does not leave
    the model's box by more than its reach. Raises `TrackingError` when shapes don't fit, or the
    model's errors are not finite.
    """
    count, width = len(coils.offsets), model.moments.shape[1]
    if flux.shape != (count, width):
        raise TrackingError(f'{count} coils and {width} components, got flux {flux.shape}')
    start = np.array(position, dtype=np.float64), np.array(rotation, dtype=np.float64)
    is_finite, solution = solve_near(*start, coils.arrays, flux, model)
    if not is_finite:
        raise TrackingError(NOT_FINITE)
    return BodySolution(*solution)


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
    moments = field.moments.view(np.complex128)
    fields = dipole_field(grid.points, field.positions, field.directions, moments).view(np.float64)
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
