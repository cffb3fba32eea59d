"""Sensor gains, axes and lever arms estimated together with the field.

First at the measured poses, with the moments eliminated: what a wrong sensor does to the fluxes is
compared with the measurement only outside the span of the dipoles' basis (variable projection, as
for the dipoles' positions). So a sensor is never blamed for what the field could be, and whatever
the two can't be told apart in (a gain common to all, for one) stays as surveyed. Then gains
and axes once more with the poses marginalised, which the sensors of one body tell apart from the
jitter that they share; what moves or turns all of them alike is too much like a pose for that.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import ComplexArray, as_real
from anser_ros.calibration.layout_fit import RICH_DAMPING, rich_layout
from anser_ros.calibration.layouts import Generator, place
from anser_ros.calibration.moments import MomentFitter
from anser_ros.calibration.pose_correction import (
    PoseWhitener,
    Uncertainty,
    frame_blocks,
    pose_terms,
    with_pose,
)
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord
from anser_ros.physics.dipole import flux_basis, flux_jacobian

Array = NDArray[np.float64]

KINDS = ('gains', 'axes', 'lever_arm')
PLAIN_ROUNDS = 3
MARGINAL_ROUNDS = 4
PRIOR = {'gains': 0.05, 'axes': 0.05, 'lever_arm': 5e-3}
"""One standard deviation before any data: relative, rad, m."""


@dataclass(frozen=True)
class BodySurvey:
    """What the sensors of one body are found to be.

    Attributes
    ----------
    gain : ndarray, shape (S,), complex
    axis : ndarray, shape (S, 3)
        Unit axes in the body's frame.
    offset : ndarray, shape (3,)
        Of all sensors in the body's frame, m.
    records : tuple of EffectRecord
        The same as corrections that a field model carries.
    """

    gain: ComplexArray
    axis: Array
    offset: Array
    records: tuple[EffectRecord, ...]

    def apply(self, measurements: Measurements) -> Measurements:
        """The measurements as sensors that are as surveyed would have given them."""
        sensors = measurements.sensors
        return replace(
            measurements,
            flux=measurements.flux / self.gain[:, None],
            sensors=sensors.with_geometry(sensors.position + self.offset, self.axis),
        )


def tangents(axes: Array) -> Array:
    """Two unit vectors across each axis, shape (S, 2, 3)."""
    least = np.eye(3)[np.argmin(np.abs(axes), axis=1)]
    first = np.cross(axes, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axes, first)], axis=1)


class SensorSurveyor:
    """Estimates what is asked for; sessions with the same body share its parameters.

    Parameters
    ----------
    measurements : sequence of Measurements
    kinds : sequence of str
        Of `KINDS`.
    generator : Generator
    uncertainty : Uncertainty
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        kinds: Sequence[str],
        generator: Generator,
        uncertainty: Uncertainty,
    ) -> None:
        self.measured, self.kinds = list(measurements), tuple(kinds)
        self.uncertainty = uncertainty
        self.dipoles: DipoleSites = place(rich_layout(measurements, generator), generator)
        self.bodies = list(dict.fromkeys(m.body for m in measurements))
        tables = {m.body: m.sensors for m in measurements}
        self.tables = [tables[body] for body in self.bodies]
        self.starts = np.cumsum([0] + [self._size(len(table)) for table in self.tables])
        self.theta = np.zeros(self.starts[-1])
        self.covariance = np.zeros((self.theta.size, self.theta.size))

    def _size(self, sensors: int) -> int:
        gains, axes, arm = (kind in self.kinds for kind in KINDS)
        return sensors * 2 * (gains + axes) + 3 * arm

    def survey(self, body: str) -> BodySurvey:
        """A body's sensors at the present estimate."""
        index = self.bodies.index(body)
        table, part = self.tables[index], self.theta[self.starts[index] : self.starts[index + 1]]
        count = len(table)
        gain, axis, offset = np.ones(count, complex), table.axis, np.zeros(3)
        if 'gains' in self.kinds:
            pairs, part = part[: 2 * count].reshape(count, 2), part[2 * count :]
            gain = 1.0 + pairs[:, 0] + 1j * pairs[:, 1]
        if 'axes' in self.kinds:
            pairs, part = part[: 2 * count].reshape(count, 2), part[2 * count :]
            axis = axis + np.einsum('st,stj->sj', pairs, tangents(axis))
            axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        if 'lever_arm' in self.kinds:
            offset = part
        return BodySurvey(gain, axis, offset, self._records(index, gain, axis, offset))

    def _records(
        self, index: int, gain: ComplexArray, axis: Array, offset: Array
    ) -> tuple[EffectRecord, ...]:
        table, records = self.tables[index], []
        sigma = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))[self.starts[index] :]
        count, at = len(table), 0
        if 'gains' in self.kinds:
            for row, channel in enumerate(table.channel.tolist()):
                records.append(_gain_record(channel, gain[row], sigma[2 * row : 2 * row + 2]))
            at += 2 * count
        if 'axes' in self.kinds:
            for row, channel in enumerate(table.channel.tolist()):
                own = sigma[at + 2 * row : at + 2 * row + 2]
                records.append(_axis_record(channel, table.axis[row], axis[row], own))
            at += 2 * count
        if 'lever_arm' in self.kinds:
            records.append(
                EffectRecord(
                    'lever_arm',
                    {'offset_m': offset.tolist(), 'body': self.bodies[index]},
                    {'offset_m': sigma[at : at + 3].tolist()},
                )
            )
        return tuple(records)

    def fit(self) -> dict[str, BodySurvey]:
        """Alternate field and sensors; the survey of every body."""
        for _ in range(PLAIN_ROUNDS):
            corrected, fitter = self._fitter()
            # The pose correction only says which readings are outliers: corrected poses would have
            # taken up what the sensors are to explain.
            moments, spectrum = fitter.solve(exact=False)
            noise = fitter.correct(moments, spectrum.freedom(RICH_DAMPING))
            weights = [state.weights for state in fitter.states]
            self._step(corrected, moments, weights, noise, marginal=False)
        free = self._told_apart_from_poses()
        rest = np.eye(self.theta.size) - free @ free.T
        plain = rest @ self.covariance @ rest
        for _ in range(MARGINAL_ROUNDS if free.size else 0):
            corrected, fitter = self._fitter()
            found = fitter.fit(3, exact=False)
            step = self._step(corrected, found.moments, found.weights, found.noise_t, True)
            if np.all(np.abs(step) <= 0.1 * np.sqrt(np.diag(self.covariance))):
                break
        self.covariance = free @ free.T @ self.covariance @ free @ free.T + plain
        return {body: self.survey(body) for body in self.bodies}

    def _fitter(self) -> tuple[list[Measurements], MomentFitter]:
        surveys = [self.survey(m.body) for m in self.measured]
        corrected = [with_pose(s.apply(m)) for s, m in zip(surveys, self.measured, strict=True)]
        return corrected, MomentFitter(corrected, self.dipoles, RICH_DAMPING, self.uncertainty)

    def _told_apart_from_poses(self) -> Array:
        """Basis (Q, Q') of what is no common shift and no common turn of a body's sensors."""
        like_a_pose = []
        for table, end in zip(self.tables, self.starts[1:], strict=True):
            arm = 3 if 'lever_arm' in self.kinds else 0
            if arm:
                like_a_pose += list(np.eye(self.theta.size)[end - 3 : end])
            if 'axes' in self.kinds:
                for turn in np.eye(3):
                    row = np.zeros(self.theta.size)
                    moved = np.cross(turn, table.axis)
                    first = end - arm - 2 * len(table)
                    tilt = np.einsum('stj,sj->st', tangents(table.axis), moved)
                    row[first : end - arm] = tilt.ravel()
                    like_a_pose.append(row)
        if not like_a_pose:
            return np.eye(self.theta.size)
        u, s, _ = np.linalg.svd(np.stack(like_a_pose, axis=1), full_matrices=True)
        return np.asarray(u[:, int((s > 1e-9 * s[0]).sum()) :])

    def _step(
        self,
        corrected: Sequence[Measurements],
        moments: ComplexArray,
        weights: Sequence[Array],
        noise_t: float,
        marginal: bool,
    ) -> Array:
        """One Gauss-Newton step of the sensor parameters with the moments eliminated.

        With the poses marginalised, slopes and residuals are what no pose explains, and what is
        like a pose stays. Without, the residual is mostly the jitter that all readings of a frame
        share: its variance counts as that of as many readings as a pose has parameters.
        """
        size, unknowns, parts = len(self.dipoles), self.theta.size, 2 * moments.shape[1]
        gram, mixed = np.zeros((size, size)), np.zeros((size, (unknowns + 1) * parts))
        inner, power, count, frames = np.zeros((unknowns + 1, unknowns + 1)), 0.0, 0.0, 0
        for m, weight in zip(corrected, weights, strict=True):
            frames += len(m.time)
            for block in frame_blocks(len(m.time), len(m.sensors), 2048):
                part = m.frames(block)  # type: ignore[arg-type]
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
        precision = np.diag(1.0 / self._prior() ** 2)
        free = self._told_apart_from_poses() if marginal else np.eye(self.theta.size)
        inner = free.T @ (normal + precision) @ free
        covariance = free @ np.linalg.inv(inner) @ free.T
        step = covariance @ (gradient - precision @ self.theta)
        self.theta, self.covariance = self.theta + step, covariance
        self._fix_common_gain()
        return np.asarray(step)

    def _fix_common_gain(self) -> None:
        """A gain common to all sensors is the emitters' as well: the median one is set to one."""
        if 'gains' not in self.kinds:
            return
        rows = np.concatenate(
            [
                start + np.arange(2 * len(table))
                for start, table in zip(self.starts[:-1], self.tables, strict=True)
            ]
        )
        pairs = self.theta[rows].reshape(-1, 2)
        gain = 1.0 + pairs[:, 0] + 1j * pairs[:, 1]
        gain = gain / (np.median(np.abs(gain)) * np.exp(1j * np.median(np.angle(gain))))
        self.theta[rows] = np.stack([gain.real - 1.0, gain.imag], axis=1).ravel()
        common = np.zeros((self.theta.size, 2))
        common[rows[0::2], 0] = common[rows[1::2], 1] = 1.0 / np.sqrt(len(gain))
        keep = np.eye(self.theta.size) - common @ common.T
        self.covariance = keep @ self.covariance @ keep

    def _prior(self) -> Array:
        sigma = []
        for table in self.tables:
            for kind in KINDS:
                if kind in self.kinds:
                    sigma += [PRIOR[kind]] * (3 if kind == 'lever_arm' else 2 * len(table))
        return np.array(sigma)

    def _rows(
        self,
        part: Measurements,
        moments: ComplexArray,
        weights: Array,
        noise_t: float,
        marginal: bool,
    ) -> tuple[Array, Array]:
        """Basis (P, N); slopes by all parameters and, last, the residual: (P, Q + 1, 2K)."""
        points, axes = part.placed()
        frames, sensors = points.shape[:2]
        lengths = np.tile(part.sensors.length, frames)
        place_of = (points.reshape(-1, 3), axes.reshape(-1, 3), lengths)
        where = (self.dipoles.positions, self.dipoles.directions)
        flux, by_place, by_axis = flux_jacobian(*place_of, *where, moments)
        shape = (frames, sensors, 3, moments.shape[1])
        columns = self._columns(
            part,
            flux.reshape(frames, sensors, -1),
            by_place.reshape(shape),
            by_axis.reshape(shape),
        )
        terms = pose_terms(part, self.dipoles, moments)
        real = np.concatenate([as_real(columns), terms.residual[:, :, None, :]], axis=2)
        root = np.sqrt(weights)
        if marginal:
            white = PoseWhitener(terms.slope, weights, noise_t, self.uncertainty.pose_precision)
            real = np.stack([white.left_over(real[:, :, q]) for q in range(real.shape[2])], axis=2)
        else:
            real = real * root[:, :, None, None]
        basis = flux_basis(*place_of, *where) * root.reshape(-1, 1)
        return basis, real.reshape(len(basis), real.shape[2], -1)

    def _columns(
        self, part: Measurements, modelled: ComplexArray, by_place: ComplexArray,
        by_axis: ComplexArray,
    ) -> ComplexArray:  # fmt: skip
        """Derivatives (F, S, Q, K) of the fluxes by all parameters."""
        frames, sensors, emitters = modelled.shape
        out = np.zeros((frames, sensors, self.theta.size, emitters), complex)
        index = self.bodies.index(part.body)
        at = int(self.starts[index])
        if 'gains' in self.kinds:
            for s in range(sensors):
                out[:, s, at + 2 * s] = modelled[:, s]
                out[:, s, at + 2 * s + 1] = 1j * modelled[:, s]
            at += 2 * sensors
        if 'axes' in self.kinds:
            across = np.einsum('fij,stj->fsti', part.rotation, tangents(self.tables[index].axis))
            tilt = np.einsum('fsik,fsti->fstk', by_axis, across, optimize=True)
            for s in range(sensors):
                out[:, s, at + 2 * s : at + 2 * s + 2] = tilt[:, s]
            at += 2 * sensors
        if 'lever_arm' in self.kinds:
            out[:, :, at : at + 3] = np.einsum('fsik,fij->fsjk', by_place, part.rotation)
        return out


def _gain_record(channel: int, gain: complex, sigma: Array) -> EffectRecord:
    return EffectRecord(
        'sensor_gain',
        {
            'channel': channel,
            'gain': float(abs(gain)),
            'phase_deg': float(np.degrees(np.angle(gain))),
        },
        {'gain': float(sigma[0]), 'phase_deg': float(np.degrees(sigma[1] / abs(gain)))},
    )


def _axis_record(channel: int, surveyed: Array, axis: Array, sigma: Array) -> EffectRecord:
    tilt = np.arctan2(np.linalg.norm(np.cross(surveyed, axis)), float(surveyed @ axis))
    return EffectRecord(
        'sensor_axis',
        {
            'channel': channel,
            'tilt_deg': float(np.degrees(tilt)),
            'axis': axis.tolist(),
            'surveyed_axis': surveyed.tolist(),
        },
        {'tilt_deg': float(np.degrees(np.linalg.norm(sigma)))},
    )
