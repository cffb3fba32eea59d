"""Parameters of the sensors of all bodies in one vector: gains, axes and lever arms.

A body with S sensors has, in this order and as far as they are estimated, two numbers a sensor for
its gain (real part minus one, imaginary part), two a sensor for the tilt of its axis (rad, along
two directions across the surveyed axis), and three for its lever arm (m, in the body's frame).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

KINDS = ('gains', 'axes', 'lever_arm')
PRIOR = {'gains': 0.05, 'axes': 0.05, 'lever_arm': 5e-3}
"""Standard deviation of each parameter before any data: relative, rad, m. The values are wide for
sensors that were surveyed at all; they only hold what the data do not determine."""


@dataclass(frozen=True)
class BodySurvey:
    """Estimated gains, axes and lever arm of the sensors of one body.

    Attributes
    ----------
    gain : ndarray, shape (S,), complex
        Factor of each sensor's fluxes.
    axis : ndarray, shape (S, 3)
        Unit axes in the body's frame.
    offset : ndarray, shape (3,)
        Shift of all sensors in the body's frame, m.
    records : tuple of EffectRecord
        The same estimates as corrections that a field model carries.
    """

    gain: ComplexArray
    axis: Array
    offset: Array
    records: tuple[EffectRecord, ...]

    def apply(self, measurements: Measurements) -> Measurements:
        """Return the measurements with their gains, axes and positions corrected."""
        sensors = measurements.sensors
        return replace(
            measurements,
            flux=measurements.flux / self.gain[:, None],
            sensors=sensors.with_geometry(sensors.position + self.offset, self.axis),
        )


def tangents(axes: Array) -> Array:
    """Return two unit vectors across each unit axis, shape (S, 2, 3), for axes of shape (S, 3)."""
    least = np.eye(3)[np.argmin(np.abs(axes), axis=1)]
    first = np.cross(axes, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axes, first)], axis=1)


class SensorParameters:
    """The order of the parameters in their vector, and what they do to fluxes.

    Parameters
    ----------
    measurements : sequence of Measurements
        Sessions with the same body share the parameters of its sensors.
    kinds : sequence of str
        What is estimated, of `KINDS`.
    """

    def __init__(self, measurements: Sequence[Measurements], kinds: Sequence[str]) -> None:
        self.kinds = tuple(kinds)
        self.bodies = list(dict.fromkeys(m.body for m in measurements))
        tables = {m.body: m.sensors for m in measurements}
        self.tables: list[SensorTable] = [tables[body] for body in self.bodies]
        self.starts = np.cumsum([0] + [self._size(len(table)) for table in self.tables])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def _size(self, sensors: int) -> int:
        gains, axes, arm = (kind in self.kinds for kind in KINDS)
        return sensors * 2 * (gains + axes) + 3 * arm

    @property
    def prior_sigma(self) -> Array:
        """Standard deviation of every parameter before any data, shape (Q,)."""
        sigma = []
        for table in self.tables:
            for kind in KINDS:
                if kind in self.kinds:
                    sigma += [PRIOR[kind]] * (3 if kind == 'lever_arm' else 2 * len(table))
        return np.array(sigma)

    @property
    def gain_rows(self) -> NDArray[np.int64]:
        """Indices of all gains' real and imaginary parts by turns; they must be estimated."""
        return np.concatenate(
            [
                start + np.arange(2 * len(table))
                for start, table in zip(self.starts[:-1], self.tables, strict=True)
            ]
        )

    def survey(self, body: str, values: Array, covariance: Array) -> BodySurvey:
        """Return the survey of a body's sensors.

        Parameters
        ----------
        body : str
            Name of the body.
        values : ndarray, shape (Q,)
            All parameters.
        covariance : ndarray, shape (Q, Q)
            Their covariance, for the uncertainties in the records.
        """
        index = self.bodies.index(body)
        table, part = self.tables[index], values[self.starts[index] : self.starts[index + 1]]
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
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))[self.starts[index] :]
        return BodySurvey(gain, axis, offset, self._records(index, gain, axis, offset, sigma))

    def _records(
        self, index: int, gain: ComplexArray, axis: Array, offset: Array, sigma: Array
    ) -> tuple[EffectRecord, ...]:
        table, records = self.tables[index], []
        count, start = len(table), 0
        if 'gains' in self.kinds:
            for row, channel in enumerate(table.channel.tolist()):
                records.append(_gain_record(channel, gain[row], sigma[2 * row : 2 * row + 2]))
            start += 2 * count
        if 'axes' in self.kinds:
            for row, channel in enumerate(table.channel.tolist()):
                tilt_sigma = sigma[start + 2 * row : start + 2 * row + 2]
                records.append(_axis_record(channel, table.axis[row], axis[row], tilt_sigma))
            start += 2 * count
        if 'lever_arm' in self.kinds:
            records.append(
                EffectRecord(
                    'lever_arm',
                    {'offset_m': offset.tolist(), 'body': self.bodies[index]},
                    {'offset_m': sigma[start : start + 3].tolist()},
                )
            )
        return tuple(records)

    def derivatives(
        self, part: Measurements, modelled: ComplexArray, by_place: ComplexArray,
        by_axis: ComplexArray,
    ) -> ComplexArray:  # fmt: skip
        """Return the derivatives of fluxes by all parameters.

        Parameters
        ----------
        part : Measurements
            F frames of the S sensors of one body.
        modelled : ndarray, shape (F, S, K), complex
            Modelled fluxes, T.
        by_place, by_axis : ndarray, shape (F, S, 3, K), complex
            Their derivatives by the sensors' positions (T/m) and axes (T), frame fg.

        Returns
        -------
        ndarray, shape (F, S, Q, K), complex
            T per unit of the parameter; zero for the parameters of other bodies.
        """
        frames, sensors, emitters = modelled.shape
        out = np.zeros((frames, sensors, len(self), emitters), complex)
        index = self.bodies.index(part.body)
        start = int(self.starts[index])
        if 'gains' in self.kinds:
            for s in range(sensors):
                out[:, s, start + 2 * s] = modelled[:, s]
                out[:, s, start + 2 * s + 1] = 1j * modelled[:, s]
            start += 2 * sensors
        if 'axes' in self.kinds:
            across = np.einsum('fij,stj->fsti', part.rotation, tangents(self.tables[index].axis))
            tilt = np.einsum('fsik,fsti->fstk', by_axis, across, optimize=True)
            for s in range(sensors):
                out[:, s, start + 2 * s : start + 2 * s + 2] = tilt[:, s]
            start += 2 * sensors
        if 'lever_arm' in self.kinds:
            out[:, :, start : start + 3] = np.einsum('fsik,fij->fsjk', by_place, part.rotation)
        return out

    def separable_from_poses(self) -> Array:
        """Return an orthonormal basis (Q, Q') of what no movement of a body's pose resembles.

        A lever arm shifts all sensors of a body alike, and some tilts of all axes together are a
        rotation of the body; the basis spans everything else.
        """
        like_a_pose = []
        for table, end in zip(self.tables, self.starts[1:], strict=True):
            arm = 3 if 'lever_arm' in self.kinds else 0
            if arm:
                like_a_pose += list(np.eye(len(self))[end - 3 : end])
            if 'axes' in self.kinds:
                for rotation in np.eye(3):
                    row = np.zeros(len(self))
                    change = np.cross(rotation, table.axis)
                    first = end - arm - 2 * len(table)
                    tilt = np.einsum('stj,sj->st', tangents(table.axis), change)
                    row[first : end - arm] = tilt.ravel()
                    like_a_pose.append(row)
        if not like_a_pose:
            return np.eye(len(self))
        u, s, _ = np.linalg.svd(np.stack(like_a_pose, axis=1), full_matrices=True)
        return np.asarray(u[:, int((s > 1e-9 * s[0]).sum()) :])


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
