"""Sums normal equations of a field and of the sensors' parameters, with every pose marginalised.

All of a frame's readings share the error of its optical pose, along six known directions J. With
flux noise sigma and the covariance S of the pose the readings have the covariance ``sigma^2 I + J
S J^T``, whose inverse takes a 6 x 6 matrix a frame (Golub and Van Loan, Matrix Computations,
section 2.1.4). Field and parameters are weighed with it together, so that one solution divides
correctly what a pose, the field and a parameter could each explain. To keep the system small the
field is written in those modes of a rich layer of dipoles that the readings determine.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites, basis_rows
from anser_ros.calibration.factors import as_complex, as_real
from anser_ros.calibration.normal_factor import NormalFactor, subtract_gram
from anser_ros.calibration.pose_correction import pose_slopes
from anser_ros.calibration.readings import frame_blocks
from anser_ros.calibration.sensor_parameters import SensorParameters, velocity_of
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_jacobian

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_MOST_MODES, MOST_MODES = 160, 240
"""Modes of the field at most, for a scan of minutes and for a short one. With fewer, what they
miss of a wide board's field passes for an error of the lever arm: with 160, 20 pT and 0.1 mm in
20 s by a camera that jitters by 0.3 mm. The size of the system grows in proportion."""
MODES_WORK = 6e7
"""Frames times the square of the modes, to which the time of a step is proportional."""
POSES_A_MODE = 2.0
"""Poses for each mode of more than the least number: fewer determine none of the finest modes."""
LEAST_MODE = 1e-8
"""Singular value of a mode at least, relative to the largest."""
SYSTEM_ROWS = 1200
"""Readings in memory at a time: each has a row for every parameter."""
STRETCHES = 20
"""Stretches of a body's frames at least: how much their scores scatter tells the weight of the
fluxes, of which two stretches tell nothing. Many more are shorter than the way over which errors
of the field's model are alike."""


@dataclass(frozen=True)
class FieldModes:
    """Combines dipoles whose fluxes are orthogonal over a scan's readings.

    Attributes
    ----------
    sites : DipoleSites
        N dipoles.
    vectors : ndarray, shape (N, M)
        Moments of each mode, A m^2, for a flux of 1 T rms over the readings.
    size : ndarray, shape (M,)
        Singular values relative to the largest: how strongly a moment makes each mode.
    """

    sites: DipoleSites
    vectors: Array
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
class Linear:
    """Holds the readings of one body about the present estimate.

    Attributes
    ----------
    part : Measurements
        F frames, corrected by the present parameters.
    residual : ndarray, shape (F, S, 2K)
        Measured minus modelled flux, T; real and imaginary parts by turns.
    slope : ndarray, shape (F, S, 2K, 6)
        Derivative of the flux by the pose, T/m and T/rad.
    rows : ndarray, shape (F, S, M)
        Flux of each mode.
    flux : ndarray, shape (F, S, K), complex
        Modelled, T.
    by_place, by_axis : ndarray, shape (F, S, 3, K), complex
        Its derivatives by the sensors' places (T/m) and axes (T).
    """

    part: Measurements
    residual: Array
    slope: Array
    rows: Array
    flux: ComplexArray
    by_place: ComplexArray
    by_axis: ComplexArray


def linearise(part: Measurements, modes: FieldModes, field: Array) -> Linear:
    """Evaluate a field, given by its modes (M, 2K), and all derivatives at a body's poses."""
    points, axes = part.placed()
    frames, sensors = points.shape[:2]
    lengths = np.tile(part.sensors.length, frames)
    flat = (points.reshape(-1, 3), axes.reshape(-1, 3), lengths)
    moments = as_complex(modes.vectors @ field)
    sites = (modes.sites.positions, modes.sites.directions)
    flux, by_place, by_axis = flux_jacobian(*flat, *sites, moments)
    shape = (frames, sensors, 3, moments.shape[1])
    by_place, by_axis = by_place.reshape(shape), by_axis.reshape(shape)
    flux = flux.reshape(frames, sensors, -1)
    return Linear(
        part,
        as_real(part.flux) - as_real(flux),
        pose_slopes(points, axes, part.position, by_place, by_axis),
        (basis_rows(part, modes.sites) @ modes.vectors).reshape(frames, sensors, -1),
        flux,
        by_place,
        by_axis,
    )


class JointSystem:
    """Sums of the weighted readings: what they say of field and parameters together.

    Parameters
    ----------
    parameters : SensorParameters
        Q of them.
    modes : FieldModes
        M of them.
    parts : int
        Real and imaginary parts of all emitters, 2K.
    """

    def __init__(self, parameters: SensorParameters, modes: FieldModes, parts: int) -> None:
        self.parameters, self.modes, self.parts = parameters, modes, parts
        self.fields = parts * modes.size.size
        width = self.fields + len(parameters) + 1
        self.normal = np.zeros((width, width))  # its upper triangle
        self.scores: list[Array] = []

    def add(
        self, linear: Linear, weights: Array, noise_t: float, jitter: Array, share: Array
    ) -> None:
        """Take in the frames of a body.

        Parameters
        ----------
        linear : Linear
            F frames.
        weights : ndarray, shape (F, S)
            Weights of the readings in [0, 1].
        noise_t : float
            Flux noise of a phasor component, T.
        jitter : ndarray, shape (6,)
            Standard deviations of an optical pose, m and rad.
        share : ndarray, shape (F,)
            Share of its variance that is left after interpolation.
        """
        velocity = velocity_of(linear.part)
        modes = self.modes.size.size
        count, sensors = weights.shape
        stretches = max(STRETCHES, len(frame_blocks(count, sensors, SYSTEM_ROWS)))
        edges = np.unique(np.linspace(0, count, stretches + 1).astype(int)).tolist()
        for block in (slice(*pair) for pair in pairwise(edges)):
            part, root = linear.part.frames(block), np.sqrt(weights[block]) / noise_t
            columns = self.parameters.derivatives(
                part, linear.flux[block], linear.by_place[block], linear.by_axis[block],
                velocity[block],
            )  # fmt: skip
            right = np.concatenate(
                [as_real(columns), linear.residual[block][:, :, None, :]], axis=2
            )
            right = right * root[:, :, None, None]
            rows = linear.rows[block][..., :modes] * root[:, :, None]
            slope = linear.slope[block] * root[:, :, None, None]
            count, sensors = root.shape
            flat = slope.reshape(count, -1, 6)
            prior = 1.0 / (np.maximum(jitter, 1e-9) ** 2 * share[block, None])
            precision = flat.transpose(0, 2, 1) @ flat + prior[:, :, None] * np.eye(6)
            # The inverse of the transposed factor is a root of the pose's covariance.
            lower = np.linalg.cholesky(precision)
            along = np.linalg.solve(lower, flat.transpose(0, 2, 1))
            along = along.reshape(count, 6, sensors, self.parts)
            by_field = along.transpose(0, 1, 3, 2).reshape(count, -1, sensors) @ rows
            by_rest = along.reshape(count, 6, -1) @ right.transpose(0, 1, 3, 2).reshape(
                count, sensors * self.parts, -1
            )
            taken = np.concatenate([by_field.reshape(count, 6, -1), by_rest], axis=2)
            taken = taken.reshape(6 * count, -1)
            score = -(taken[:, :-1].T @ taken[:, -1])
            subtract_gram(self.normal, taken)
            flat_rows = rows.reshape(-1, modes)
            gram = flat_rows.T @ flat_rows
            mixed = np.tensordot(rows, right, axes=([0, 1], [0, 1]))
            for c in range(self.parts):
                own = slice(c * modes, (c + 1) * modes)
                self.normal[own, own] += gram
                self.normal[own, self.fields :] += mixed[:, :, c]
                score[own] += mixed[:, -1, c]
            columns_flat = right.transpose(2, 0, 1, 3).reshape(right.shape[2], -1)
            inner = columns_flat @ columns_flat.T
            self.normal[self.fields :, self.fields :] += inner
            score[self.fields :] += inner[:-1, -1]
            self.scores.append(score)

    def eliminate(self, field_precision: Array, pull: Array) -> 'Eliminated':
        """Return what is left for the parameters when the field is eliminated.

        Parameters
        ----------
        field_precision : ndarray, shape (M,)
            Prior precision of each mode's amplitude.
        pull : ndarray, shape (M, 2K)
            Prior mean minus present amplitude, T.
        """
        n = self.fields
        precision = np.tile(field_precision, self.parts)
        inner = self.normal[:n, :n].copy()
        inner[np.diag_indices(n)] += precision
        factor = NormalFactor(inner)
        right = self.normal[:n, n:].copy()
        right[:, -1] += precision * pull.T.ravel()
        inside = factor.solve(right)
        own = np.triu(self.normal[n:, n:])
        rest = own + np.triu(own, 1).T - self.normal[:n, n:].T @ inside
        gradient = self.normal[n:-1, -1] - inside[:, :-1].T @ right[:, -1]
        scores = np.array([s[n:] - inside[:, :-1].T @ s[:n] for s in self.scores])
        variance = factor.inverse_diagonal().reshape(self.parts, -1).T.copy()
        return Eliminated(rest[:-1, :-1], gradient, inside, scores, variance)


@dataclass(frozen=True)
class Eliminated:
    """Holds what remains for the parameters once the field is eliminated.

    Attributes
    ----------
    information : ndarray, shape (Q, Q)
        Of the parameters.
    gradient : ndarray, shape (Q,)
        Of the log-likelihood at the present parameters.
    inside : ndarray, shape (2KM, Q + 1)
        The field's answer to each parameter, and its own step.
    scores : ndarray, shape (B, Q)
        The gradient's parts from the blocks of frames.
    field_variance : ndarray, shape (M, 2K)
        Of the modes' amplitudes at fixed parameters, T^2.
    """

    information: Array
    gradient: Array
    inside: Array
    scores: Array
    field_variance: Array

    @property
    def inflation(self) -> float:
        """Return by how much more the scores of whole stretches scatter than those of independent
        readings would.

        It is the median over the parameters, for a sensor that changes on the way scatters its own
        alone; one without parameters.
        """
        count = len(self.scores)
        power = (self.scores**2).sum(axis=0) * count / max(count - 1, 1)
        size = np.maximum(np.diag(self.information), 1e-300)
        return float(np.median(power / size)) if size.size else 1.0

    def field_step(self, step: Array, modes: int) -> Array:
        """Return the field's step (M, 2K) that goes with a step of the parameters (Q,)."""
        flat = self.inside[:, -1] - self.inside[:, :-1] @ step
        return np.asarray(flat.reshape(-1, modes).T)
