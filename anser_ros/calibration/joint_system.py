"""Sums normal equations of a field and of the sensors' parameters, with every pose marginalised.

All of a frame's readings share the error of its optical pose, along six known directions J. With
flux noise sigma and the covariance S of the pose the readings have the covariance ``sigma^2 I + J
S J^T``, whose inverse takes a 6 x 6 matrix a frame (Golub and Van Loan, Matrix Computations,
section 2.1.4). Field and parameters are weighed with it together, so that one solution divides
correctly what a pose, the field and a parameter could each explain. To keep the system small the
field is written in those modes of a rich layer of dipoles that the readings determine.

Poses tie the parts of the field together, real and imaginary of every emitter. Without metal the
imaginary parts are nearly zero wherever a sensor is, so no pose has to do with them: they are
solved one by one then, in a small part of the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers, as_complex, as_real
from anser_ros.calibration.least_squares import NormalFactor, subtract_gram
from anser_ros.calibration.moments import PoseTerms, PoseWhitener, pose_slopes
from anser_ros.calibration.readings import DipoleSites, basis_rows, flux_slopes, frame_blocks
from anser_ros.calibration.sensor_parameters import SensorParameters, velocity_of
from anser_ros.field.measurements import Measurements
from anser_ros.parallel import in_order, slices

LEAST_MOST_MODES, MOST_MODES = 160, 240
"""Modes of the field at most, for a scan of minutes and for a short one. What 160 miss of a wide
board's field passes for 0.1 mm of lever arm, with a poor camera."""
MODES_WORK = 6e7
"""Frames times the square of the modes, to which the time of a step is proportional."""
POSES_A_MODE = 2.0
"""Poses for each mode of more than the least number: fewer determine none of the finest modes."""
LEAST_MODE = 1e-8
"""Singular value of a mode at least, relative to the largest."""
SYSTEM_ROWS = 1200
"""Readings in memory at a time: each has a row for every parameter."""
POSE_ROWS = 3000
"""Rows of the open poses, six a frame, that are subtracted together at least: fewer are slow."""
FAR_LESS, MOST_RATIO = 4.0, 1e3
"""Ratio of scatters from which on a kind of parameters is known better than the others: such as
delays, which only show where nothing else does; and the most that is made of it."""
LEAST_OPEN = 1e-4
"""Variance that open poses add to a part's readings on average, relative to the noise's, up to
which they have nothing to do with it: 1e-9 without metal, 4e-5 to 1e-4 near large pieces."""
STRETCHES = 20
"""Stretches of a body's frames at least, whose scores' scatter tells the weight of the fluxes."""


@dataclass(frozen=True)
class FieldModes:
    """Combines dipoles whose fluxes are orthogonal over a scan's readings."""

    sites: DipoleSites  # N dipoles
    vectors: Array  # (N, M): moments of each mode, A m^2, for a flux of 1 T rms over the readings
    # (M,): singular values relative to the largest: how strongly a moment makes each mode
    size: Array

    @staticmethod
    def of(
        measurements: Sequence[Measurements], sites: DipoleSites, most: int = LEAST_MOST_MODES
    ) -> 'FieldModes':
        """Return the modes of dipoles over the usable readings of measurements at their poses."""
        gram, count = np.zeros((len(sites), len(sites))), 0.0
        for m in measurements:
            for block in frame_blocks(len(m.time), len(m.sensors)):
                part = m.frames(block)
                rows = basis_rows(part, sites)[part.usable.ravel()]
                gram, count = gram + rows.T @ rows, count + len(rows)
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        size = np.sqrt(values / values[0])
        keep = (size > LEAST_MODE) & (np.arange(size.size) < most)
        moments = vectors[:, keep] / scale[:, None] / np.sqrt(values[keep] / count)
        return FieldModes(sites, moments, size[keep])

    def strongest(self, count: int) -> 'FieldModes':
        """Return so many of the modes."""
        return FieldModes(self.sites, self.vectors[:, :count], self.size[:count])


@dataclass(frozen=True)
class Linear(PoseTerms):
    """Holds the readings of one body, at the present estimate, with all of their derivatives."""

    part: Measurements  # F frames, corrected by the present parameters
    modes: FieldModes  # M of them
    flux: ComplexArray  # (F, S, K): modelled, T
    # by_place, by_axis (F, S, 3, K): its derivatives by the sensors' places (T/m) and axes (T)
    by_place: ComplexArray
    by_axis: ComplexArray

    @cached_property
    def rows(self) -> Array:
        """Return the flux of each mode, (F, S, M)."""
        rows = basis_rows(self.part, self.modes.sites) @ self.modes.vectors
        return rows.reshape(*self.flux.shape[:2], -1)


def linearise(part: Measurements, modes: FieldModes, field: Array) -> Linear:
    """Evaluate a field, given by its modes (M, 2K), and all derivatives at a body's poses."""
    flux, by_place, by_axis = flux_slopes(part, modes.sites, as_complex(modes.vectors @ field))
    return Linear(
        as_real(part.flux) - as_real(flux),
        pose_slopes(*part.placed(), part.position, by_place, by_axis), part, modes, flux,
        by_place, by_axis,
    )  # fmt: skip


def open_directions(
    linear: Linear, weights: Array, noise_t: float, jitter: Array, share: Array
) -> Array:
    """Return what the poses, as far as they are open, do to the readings, shape (F, 6, S, 2K).

    In units of the noise; the readings' inverse covariance is the unit matrix less the product of
    a frame's six rows with themselves.

    ``linear``: F frames. ``share`` (F,): share of its variance that is left after interpolation.
    """
    prior = 1.0 / (np.maximum(jitter, 1e-9) ** 2 * share[:, None])
    white = PoseWhitener(linear.slope, weights, noise_t, prior)
    # The inverse of the transposed factor is a root of the pose's covariance.
    along = np.linalg.solve(np.linalg.cholesky(white.precision), white.slope)
    return np.asarray(along.reshape(len(along), 6, *linear.slope.shape[1:3]))


def tied_parts(along: Sequence[Array]) -> Booleans:
    """Return to which parts (2K,) open poses add more than `LEAST_OPEN`, in any of the bodies."""
    added = np.array([(a**2).sum(axis=(0, 1, 2)) / max(len(a) * a.shape[2], 1) for a in along])
    return np.asarray((added > LEAST_OPEN).any(axis=0))


class JointSystem:
    """Sums of the weighted readings: what they say of field and parameters together.

    ``modes``: M of them. ``tied`` (2K,): real and imaginary parts of the emitters' field that
    poses tie together.
    """

    def __init__(self, parameters: SensorParameters, modes: FieldModes, tied: Booleans) -> None:
        self.parameters, self.modes, self.tied = parameters, modes, tied
        self.parts, self.count = tied.size, modes.size.size
        rest = len(parameters) + 1
        width = int(tied.sum()) * self.count + rest
        # The poses' part of the normal matrix of tied parts and parameters, its upper triangle.
        self.open = np.zeros((width, width))
        self.gram = np.zeros((self.count, self.count))  # of every part of the field
        self.mixed = np.zeros((self.parts, self.count, rest))
        self.own = np.zeros((rest, rest))
        self.scores: list[Array] = []

    def add(self, linear: Linear, weights: Array, noise_t: float, along: Array) -> None:
        """Take in the frames of a body; ``along`` is that of `open_directions`."""
        velocity, along = velocity_of(linear.part), np.where(self.tied, along, 0.0)
        (count, sensors), modes = weights.shape, linear.rows[..., : self.count]
        stretches = max(STRETCHES, len(frame_blocks(count, sensors, SYSTEM_ROWS)))
        edges = np.unique(np.linspace(0, count, stretches + 1).astype(int)).tolist()
        blocks = [slice(*pair) for pair in pairwise(edges)]

        def sums(block: slice) -> tuple[Array, ...]:
            part, root = linear.part.frames(block), np.sqrt(weights[block]) / noise_t
            columns = self.parameters.derivatives(
                part, linear.flux[block], linear.by_place[block], linear.by_axis[block],
                velocity[block],
            )  # fmt: skip
            right = np.empty((*root.shape, self.parts, columns.shape[2] + 1))
            right[..., :-1] = as_real(columns).transpose(0, 1, 3, 2)
            right[..., -1] = linear.residual[block]
            right *= root[:, :, None, None]
            rows = modes[block] * root[:, :, None]
            flat, flat_right = rows.reshape(-1, self.count), right.reshape(-1, right.shape[3])
            mixed = (flat.T @ right.reshape(len(flat), -1)).reshape(self.count, self.parts, -1)
            taken = self._taken(along[block], rows, right)
            return taken, flat.T @ flat, mixed.transpose(1, 0, 2), flat_right.T @ flat_right

        several = max(1, -(-len(blocks) * POSE_ROWS // max(6 * count, 1)))
        for few in slices(len(blocks), several):
            found = in_order(sums, blocks[few])
            subtract_gram(self.open, np.concatenate([taken for taken, *_ in found]))
            for taken, gram, mixed, own in found:
                self.gram += gram
                self.mixed += mixed
                self.own += own
                self.scores.append(self._score(mixed[:, :, -1], own[:-1, -1], taken))

    def _taken(self, along: Array, rows: Array, right: Array) -> Array:
        """Return what open poses take, six rows a frame: of tied parts, parameters, residual."""
        count, _, sensors, parts = along.shape
        tied = np.ascontiguousarray(along[..., self.tied].transpose(0, 1, 3, 2))
        by_field = tied.reshape(count, -1, sensors) @ rows
        by_rest = along.reshape(count, 6, -1) @ right.reshape(count, sensors * parts, -1)
        taken = np.concatenate([by_field.reshape(count, 6, -1), by_rest], axis=2)
        return np.asarray(taken.reshape(6 * count, -1))

    def _score(self, by_field: Array, by_parameters: Array, taken: Array) -> Array:
        """Return a stretch's gradient: of the fields (2K M) part by part, and parameters (Q)."""
        gone = taken[:, :-1].T @ taken[:, -1]
        field = by_field.copy()
        tied = int(self.tied.sum())
        field[self.tied] -= gone[: tied * self.count].reshape(tied, self.count)
        return np.concatenate([field.ravel(), by_parameters - gone[tied * self.count :]])

    def eliminate(self, field_precision: Array, pull: Array) -> 'Eliminated':
        """Return what is left for the parameters when the field is eliminated.

        ``field_precision`` (M,): prior precision of each mode's amplitude. ``pull`` (M, 2K): prior
        mean minus present amplitude, T.
        """
        tied, n = self.tied, int(self.tied.sum()) * self.count
        block = self.gram + np.diag(field_precision)
        right = self.mixed.copy()
        right[tied] += self.open[:n, n:].reshape(right[tied].shape)
        right[:, :, -1] += (field_precision[:, None] * pull).T
        inside, variance = np.empty_like(right), np.empty((self.parts, self.count))
        inner = self.open[:n, :n].copy()
        for start in range(0, n, self.count):
            own = slice(start, start + self.count)
            inner[own, own] += block
        for parts, matrix in ((tied, inner), (~tied, block)):
            if not parts.any():
                continue
            factor = NormalFactor(matrix)
            alike = right[parts].reshape(-1, len(matrix), right.shape[2])
            # Parts that nothing ties have one matrix, and are right-hand sides beside each other.
            beside = np.concatenate(list(alike), axis=1)
            found = np.split(factor.solve(beside), len(alike), axis=1)
            inside[parts] = np.reshape(found, inside[parts].shape)
            variance[parts] = factor.inverse_diagonal().reshape(-1, self.count)
        flat, answers = right.reshape(-1, right.shape[2]), inside.reshape(-1, right.shape[2])
        taken = np.triu(self.open[n:, n:])
        rest = self.own + taken + np.triu(taken, 1).T - answers.T @ flat
        # Its last column alone knows of the prior mean, as the gradient has to.
        scores = np.array(
            [s[len(flat) :] - answers[:, :-1].T @ s[: len(flat)] for s in self.scores]
        )
        return Eliminated(rest[:-1, :-1], rest[:-1, -1], answers, scores, variance.T.copy())


@dataclass(frozen=True)
class Eliminated:
    """Holds what remains for the parameters once the field is eliminated."""

    information: Array  # (Q, Q): of the parameters
    gradient: Array  # (Q,): of the log-likelihood at the present parameters
    inside: Array  # (2KM, Q + 1): the field's answer to each parameter, and its own step
    scores: Array  # (B, Q): the gradient's parts from the blocks of frames
    field_variance: Array  # (M, 2K): of the modes' amplitudes at fixed parameters, T^2

    @property
    def inflation(self) -> float:
        """Return by how much more scores of stretches scatter than independent readings' would.

        The median over the parameters, for a sensor that changes scatters its own alone; one
        without parameters.
        """
        return float(np.median(self.scatter)) if self.scatter.size else 1.0

    @property
    def scatter(self) -> Array:
        """Return the same of each parameter, (Q,)."""
        count = len(self.scores)
        power = (self.scores**2).sum(axis=0) * count / max(count - 1, 1)
        return np.asarray(power / np.maximum(np.diag(self.information), 1e-300))

    def likelihood(self, values: Array, kinds: Sequence[Integers]) -> tuple[Array, Array]:
        """Return information (Q, Q) of the parameters, and its product with their best values.

        ``values`` (Q,): the present ones. ``kinds``: indices of parameters of a kind: those whose
        scores scatter far less than the others' are not weakened by what makes the others scatter.
        """
        more = np.ones(values.size)
        for rows in kinds:
            ratio = self.inflation / max(float(np.median(self.scatter[rows])), 1e-300)
            if ratio > FAR_LESS:
                more[rows] = np.sqrt(min(ratio, MOST_RATIO))
        information = self.information * np.outer(more, more)
        if (more == 1.0).all():
            return information, self.gradient + information @ values
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        scaled = self.information * np.outer(scale, scale)
        step = scale * np.linalg.lstsq(scaled, scale * self.gradient, rcond=1e-12)[0]
        return information, information @ (values + step)

    def field_step(self, step: Array, modes: int) -> Array:
        """Return the field's step (M, 2K) that goes with a step of the parameters (Q,)."""
        flat = self.inside[:, -1] - self.inside[:, :-1] @ step
        return np.asarray(flat.reshape(-1, modes).T)
