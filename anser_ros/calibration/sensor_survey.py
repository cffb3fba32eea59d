"""Gains, axes and lever arms of sensors, estimated together with the field.

The first rounds use the measured poses and eliminate the dipoles' moments: the change of the
fluxes by a sensor parameter is compared with the residual only outside the span of the dipoles'
basis (variable projection, as for the dipoles' positions). A sensor thus gets no correction that a
change of the field explains as well, and what the data cannot separate from the field, such as a
gain common to all sensors, stays as surveyed. Further rounds estimate gains and axes with the
poses marginalised: the sensors of one body share the jitter of its pose, which separates it from
their parameters. A shift or rotation common to all sensors of a body resembles a pose; it is left
as the first rounds found it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import ComplexArray, as_real
from anser_ros.calibration.layout_fit import RICH_DAMPING, rich_layout
from anser_ros.calibration.layouts import Generator, place
from anser_ros.calibration.moments import MomentFitter
from anser_ros.calibration.pose_correction import pose_precision, pose_terms
from anser_ros.calibration.pose_whitening import PoseWhitener
from anser_ros.calibration.readings import frame_blocks, with_pose
from anser_ros.calibration.sensor_parameters import BodySurvey, SensorParameters
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis, flux_jacobian
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

PLAIN_ROUNDS = 3
"""Gauss-Newton steps at the measured poses. The problem is nearly linear, so that the steps after
the first only follow the change of the weights and of the field."""
MARGINAL_ROUNDS = 4
"""Largest number of further steps with marginalised poses. They end earlier once a step is smaller
than `SMALL_STEP` standard deviations of every parameter."""
SMALL_STEP = 0.1
"""Step, in standard deviations, below which another one is not worth its time."""
SURVEY_ROWS = 2048
"""Readings in memory at a time: fewer than elsewhere, since each has a row for every parameter."""


class SensorSurveyor:
    """Estimates the sensors' parameters; sessions with the same body share them.

    Parameters
    ----------
    measurements : sequence of Measurements
        Tool measurements with poses, one a body and session.
    kinds : sequence of str
        What is estimated, of `sensor_parameters.KINDS`.
    generator : Generator
        Places of the coils, for the layer of dipoles that represents the field.
    accuracy : Accuracy
        Flux noise and pose jitter.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        kinds: Sequence[str],
        generator: Generator,
        accuracy: Accuracy,
    ) -> None:
        self.measured = list(measurements)
        self.accuracy = accuracy
        self.dipoles: DipoleSites = place(rich_layout(measurements, generator), generator)
        self.parameters = SensorParameters(measurements, kinds)
        size = len(self.parameters)
        self.values, self.covariance = np.zeros(size), np.zeros((size, size))

    def survey(self, body: str) -> BodySurvey:
        """Return the survey of a body's sensors by the present estimate."""
        return self.parameters.survey(body, self.values, self.covariance)

    def fit(self) -> dict[str, BodySurvey]:
        """Alternate between field and sensors, and return the survey of every body."""
        for _ in range(PLAIN_ROUNDS):
            corrected, fitter = self._fitter()
            # The pose correction only tells which readings are outliers. Corrected poses would
            # already have absorbed the errors of the sensors.
            moments, spectrum = fitter.solve(exact=False)
            noise = fitter.correct(moments, spectrum.freedom(RICH_DAMPING))
            weights = [state.weights for state in fitter.states]
            self._step(corrected, moments, weights, noise, marginal=False)
        free = self.parameters.separable_from_poses()
        rest = np.eye(self.values.size) - free @ free.T
        plain = rest @ self.covariance @ rest
        for _ in range(MARGINAL_ROUNDS if free.size else 0):
            corrected, fitter = self._fitter()
            found = fitter.fit(3, exact=False)
            step = self._step(corrected, found.moments, found.weights, found.noise_t, True)
            if np.all(np.abs(step) <= SMALL_STEP * np.sqrt(np.diag(self.covariance))):
                break
        self.covariance = free @ free.T @ self.covariance @ free @ free.T + plain
        return {body: self.survey(body) for body in self.parameters.bodies}

    def _fitter(self) -> tuple[list[Measurements], MomentFitter]:
        surveys = [self.survey(m.body) for m in self.measured]
        corrected = [with_pose(s.apply(m)) for s, m in zip(surveys, self.measured, strict=True)]
        return corrected, MomentFitter(corrected, self.dipoles, RICH_DAMPING, self.accuracy)

    def _step(
        self,
        corrected: Sequence[Measurements],
        moments: ComplexArray,
        weights: Sequence[Array],
        noise_t: float,
        marginal: bool,
    ) -> Array:
        """Take one Gauss-Newton step of the sensor parameters with the moments eliminated.

        With marginalised poses, slopes and residuals are the parts that no pose explains, and
        what resembles a pose stays. Otherwise the residual is mostly the jitter, which all
        readings of a frame share: readings count as independent only up to the six parameters of
        a pose, and the variance is larger by the same factor.
        """
        size, unknowns, parts = len(self.dipoles), self.values.size, 2 * moments.shape[1]
        gram, mixed = np.zeros((size, size)), np.zeros((size, (unknowns + 1) * parts))
        inner, power, count, frames = np.zeros((unknowns + 1, unknowns + 1)), 0.0, 0.0, 0
        for m, weight in zip(corrected, weights, strict=True):
            frames += len(m.time)
            for block in frame_blocks(len(m.time), len(m.sensors), SURVEY_ROWS):
                part = m.frames(block)
                basis, slopes = self._rows(part, moments, weight[block], noise_t, marginal)
                gram += basis.T @ basis
                mixed += basis.T @ slopes.reshape(len(basis), -1)
                columns = slopes.transpose(1, 0, 2).reshape(unknowns + 1, -1)
                inner += columns @ columns.T
                power, count = power + float((columns[-1] ** 2).sum()), count + columns.shape[1]
        floor = RICH_DAMPING**2 * float(np.linalg.eigvalsh(gram)[-1])
        inside = np.linalg.solve(gram + floor * np.eye(size), mixed)
        span, inside = (t.reshape(size, unknowns + 1, parts) for t in (mixed, inside))
        normal = inner - np.einsum('nup,nvp->uv', span, inside, optimize=True)
        gradient = normal[:-1, -1]
        variance = noise_t**2 if marginal else power / count * max(1.0, count / frames / 6.0)
        return self._move(normal[:-1, :-1] / variance, gradient / variance, marginal)

    def _move(self, normal: Array, gradient: Array, marginal: bool) -> Array:
        precision = np.diag(1.0 / self.parameters.prior_sigma**2)
        free = self.parameters.separable_from_poses() if marginal else np.eye(self.values.size)
        inner = free.T @ (normal + precision) @ free
        covariance = free @ np.linalg.inv(inner) @ free.T
        step = covariance @ (gradient - precision @ self.values)
        self.values, self.covariance = self.values + step, covariance
        self._fix_common_gain()
        return np.asarray(step)

    def _fix_common_gain(self) -> None:
        """Set the median gain to one: the emitters may have the gain common to all sensors."""
        if 'gains' not in self.parameters.kinds:
            return
        rows = self.parameters.gain_rows
        pairs = self.values[rows].reshape(-1, 2)
        gain = 1.0 + pairs[:, 0] + 1j * pairs[:, 1]
        gain = gain / (np.median(np.abs(gain)) * np.exp(1j * np.median(np.angle(gain))))
        self.values[rows] = np.stack([gain.real - 1.0, gain.imag], axis=1).ravel()
        common = np.zeros((self.values.size, 2))
        common[rows[0::2], 0] = common[rows[1::2], 1] = 1.0 / np.sqrt(len(gain))
        keep = np.eye(self.values.size) - common @ common.T
        self.covariance = keep @ self.covariance @ keep

    def _rows(
        self,
        part: Measurements,
        moments: ComplexArray,
        weights: Array,
        noise_t: float,
        marginal: bool,
    ) -> tuple[Array, Array]:
        """Return the basis (P, N), and slopes with the residual as the last one (P, Q + 1, 2K)."""
        points, axes = part.placed()
        frames, sensors = points.shape[:2]
        lengths = np.tile(part.sensors.length, frames)
        placed = (points.reshape(-1, 3), axes.reshape(-1, 3), lengths)
        sites = (self.dipoles.positions, self.dipoles.directions)
        flux, by_place, by_axis = flux_jacobian(*placed, *sites, moments)
        shape = (frames, sensors, 3, moments.shape[1])
        columns = self.parameters.derivatives(
            part,
            flux.reshape(frames, sensors, -1),
            by_place.reshape(shape),
            by_axis.reshape(shape),
        )
        terms = pose_terms(part, self.dipoles, moments)
        real = np.concatenate([as_real(columns), terms.residual[:, :, None, :]], axis=2)
        root = np.sqrt(weights)
        if marginal:
            white = PoseWhitener(terms.slope, weights, noise_t, pose_precision(self.accuracy))
            real = np.stack([white.left_over(real[:, :, q]) for q in range(real.shape[2])], axis=2)
        else:
            real = real * root[:, :, None, None]
        basis = flux_basis(*placed, *sites) * root.reshape(-1, 1)
        return basis, real.reshape(len(basis), real.shape[2], -1)
