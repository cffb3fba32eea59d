"""Lists the errors that a scan's sensors, optics and clocks may have, and their effect on fluxes.

A body's S sensors have a complex gain each (real part minus one, imaginary part), a delay (s,
which turns each tone by its distance from the mean tone), a tilt of the axis (rad, along two
directions across the surveyed axis) and a place (m, in the body's frame);
the body has a lever arm (m). The optical clock, which all bodies share, has an offset (s) in the
middle of the scan and a rate (s a second).
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.field.measurements import Measurements
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.rotations import tangents, tilted, unturned
from anser_ros.physics.sensor import SensorTable, clusters_of

KINDS = (
    'gains', 'delays', 'axes', 'places', 'lever_arm', 'time_offset', 'clock_rate', 'registration',
    'mount',
)  # fmt: skip
EXTRA_KINDS = ('offsets',)
"""Kinds that are estimated only when asked for: constant phasors of every channel, such as the
field of the surroundings in magnetometers."""
STANDS = ('registration', 'mount')
"""Kinds that every session has a value of, where there are several: how its poses' frame stands to
the emitters', and how each body stands to what gives its poses, about what all have in common."""
POPULATIONS = ('gains', 'delays', 'axes', 'places', 'offsets', *STANDS)
"""Kinds that every sensor, or session, has a value of: one population with one spread."""
CLOCKS = ('time_offset', 'clock_rate')
"""Kinds that all bodies share."""
EACH = {'gains': 2, 'delays': 1, 'axes': 2, 'places': 3, **dict.fromkeys(STANDS, 6)}
"""Parameters a sensor, or session; offsets have the two parts of every emitter's phasor."""
ARM_M = 0.25
"""Distance, m, at which a turn is told by the way that it makes: 5 mm then stand for 20 mrad."""
PRIOR = {
    'gains': 0.05, 'delays': 1e-5, 'axes': 0.05, 'places': 5e-3, 'lever_arm': 5e-3,
    'time_offset': 0.1, 'clock_rate': 3e-3, 'offsets': 0.3, 'registration': 5e-3, 'mount': 5e-3,
}  # fmt: skip
"""Standard deviation of each parameter before any data: relative, s, rad, m, m, s, s a second,
relative to the fluxes' root mean square. Wide, for they only hold what the data leave open."""
USEFUL = {
    'gains': 2e-3, 'delays': 1e-7, 'axes': 5e-3, 'places': 2e-4, 'lever_arm': 2e-4,
    'time_offset': 1e-3, 'clock_rate': 1e-4, 'offsets': 2e-3, 'registration': 2e-4, 'mount': 2e-4,
}  # fmt: skip
"""Standard deviation, in the parameters' own units, beyond which a scan does not determine them:
that much makes errors of some tenths of a millimetre, as a tool that was not calibrated has."""
SHARED_SHIFT = 'lever_arm'
"""The kind that shifts all sensors of a body, and so the field, if nothing else distinguishes
them."""
SURVEYED_M = 1e-3
"""Standard deviation of a setup's lever arm, m along each axis, where no scan determines it: that
of a tool measured with a ruler. All places that a coil is found at are wrong by as much."""
AS_PLACES = 4.0
"""The same in widths of the places' population, where that is less: a tool whose coils are where
its setup has them is one that was measured well. An assumption, not a result."""
BY_RULE = 1e-9
"""Standard deviation, relative or m, of what a rule sets: far below any spread, and above what
rounding makes of it."""


@dataclass(frozen=True)
class BodyErrors:
    """Holds estimated errors of the sensors of one body and of the optical clock."""

    gain: ComplexArray  # (S,): factor of each sensor's fluxes
    turn: ComplexArray  # (S, K) or (S, 1): factor of each of its tones, of modulus one
    axis: Array  # (S, 3): unit axes in the body's frame
    place: Array  # (S, 3): shift of each sensor in the body's frame, m, without the lever arm
    lever_arm: Array  # (3,): shift of all sensors in the body's frame, m
    pickup: ComplexArray  # (S, K): added to each sensor's fluxes, T
    # offset_s, rate: an optical stamp t counts as ``t (1 + rate) + offset_s``
    offset_s: float
    rate: float
    # turn (rad) and shift (m), (6,) each: of the poses' frame about fg's origin, and of the body
    # as its sensors have it about its own
    registration: Array
    mount: Array

    def track(self, track: PoseTrack) -> PoseTrack:
        """Return an optical track on the clock of the fluxes."""
        turn = Rotation.from_rotvec(self.registration[:3])
        quaternion = track.quaternion
        if self.registration.any():
            quaternion = (turn * Rotation.from_quat(quaternion)).as_quat()
        return replace(
            track,
            time=track.time * (1.0 + self.rate) + self.offset_s,
            position=turn.apply(track.position) + self.registration[3:],
            quaternion=quaternion,
        )

    def apply(self, measurements: Measurements) -> Measurements:
        """Return the measurements as ideal sensors and an ideal clock would have given them."""
        sensors, turn = measurements.sensors, Rotation.from_rotvec(self.registration[:3])
        mount = Rotation.from_rotvec(self.mount[:3])
        place = mount.apply(sensors.position + self.place + self.lever_arm) + self.mount[3:]
        out = replace(
            measurements,
            flux=(measurements.flux - self.pickup) / (self.gain[:, None] * self.turn),
            sensors=replace(sensors, position=place, axis=mount.apply(self.axis)),
            position=turn.apply(measurements.position) + self.registration[3:],
            rotation=turn.as_matrix() @ measurements.rotation,
        )
        if measurements.track is None or (self.offset_s == 0.0 and self.rate == 0.0):
            return out
        track = self.track(measurements.track)
        position, rotation, seen = track.at(measurements.time)
        # Frames without a pose of their own, such as left out ones, stay without.
        seen &= measurements.has_pose
        return replace(out, track=track, position=position, rotation=rotation, has_pose=seen)


def open_ways(measurements: Sequence[Measurements]) -> Array:
    """Return unit vectors of a body along which a lever arm shifts the field, as it hardly turned.

    ``measurements``: of the body, in all sessions: several that turn about one axis each will do.
    """
    rotation = np.concatenate([m.rotation[m.has_pose] for m in measurements])
    return unturned(rotation.mean(axis=0)) if len(rotation) > 1 else np.eye(3)


def velocity_of(measurements: Measurements) -> Array:
    """Return velocities of a body, m/s and rad/s, frame fg, (F, 6); zero without a track."""
    track, time = measurements.track, measurements.time
    return np.zeros((len(time), 6)) if track is None else track.velocity(time)


def _rigid(
    by_place: ComplexArray, by_axis: ComplexArray, arms: Array, axes: Array
) -> ComplexArray:
    """Derivatives (F, S, 6, K) by a turn, times `ARM_M`, and a shift of all sensors."""
    turn = np.cross(arms[..., None], by_place, axis=2) + np.cross(axes[..., None], by_axis, axis=2)
    return np.asarray(np.concatenate([turn / ARM_M, by_place], axis=2))


class SensorParameters:
    """Orders the parameters in their vector, and knows what they do to fluxes."""

    def __init__(
        self,
        measurements: Sequence[Measurements],
        kinds: Sequence[str],
        tones_hz: Sequence[float] = (),
        is_free: bool = True,  # whether no drawing holds the field
    ) -> None:
        omega = 2.0 * np.pi * np.array(tones_hz or (0.0,))
        self.tones_hz, self.omega = tuple(tones_hz), omega - omega.mean()
        estimated = (
            set(kinds) if all(m.is_followed for m in measurements) else {*kinds} - {*CLOCKS}
        )
        bodies = list(dict.fromkeys(m.body for m in measurements))
        for body in bodies:
            own = [m for m in measurements if m.body == body]
            ways = open_ways(own)
            estimated -= {SHARED_SHIFT} if len(ways) else set()
            if is_free and len(own[0].sensors) == 1 and len(ways) == 3:
                estimated -= {'axes'}  # a tilt that all poses share is the field's too
        if not self.omega.any():
            estimated -= {'delays'}
        # Of all bodies, and of each.
        self.sessions = {
            body: list(dict.fromkeys(m.session for m in measurements if body in ('', m.body)))
            for body in ('', *bodies)
        }
        alone = () if len(self.sessions['']) > 1 else STANDS
        known = tuple(kind for kind in (*KINDS, *EXTRA_KINDS) if kind not in alone)
        self.asked = tuple(kind for kind in known if kind in kinds)
        self.kinds = tuple(kind for kind in known if kind in estimated)
        self.emitters = int(measurements[0].flux.shape[2])
        self.each = {**EACH, 'offsets': 2 * self.emitters}
        power = [np.mean(np.abs(m.flux[m.usable]) ** 2) for m in measurements if m.usable.any()]
        self.unit_t = float(np.sqrt(np.mean(power))) if power else 1.0
        self.bodies = bodies
        tables = {m.body: m.sensors for m in measurements}
        self.tables: list[SensorTable] = [tables[body] for body in self.bodies]
        times = [m.time for m in measurements if len(m.time)]
        self.middle_s = float(np.mean(np.concatenate(times))) if times else 0.0
        places = [m.position[m.has_pose] for m in measurements]
        self.pivot = np.concatenate(places).mean(axis=0)  # m, about which frames are turned
        self.slices: dict[tuple[str, str], slice] = {}
        self._size = 0
        for body, table in zip(self.bodies, self.tables, strict=True):
            for kind in (kind for kind in self.kinds if kind not in (*CLOCKS, *STANDS)):
                self._add(kind, body, self.each[kind] * len(table) if kind in self.each else 3)
        for kind in (kind for kind in self.kinds if kind in CLOCKS):
            self._add(kind, '', 1)
        for kind, body in (('registration', ''), *(('mount', body) for body in self.bodies)):
            if kind in self.kinds and len(self.sessions[body]) > 1:
                self._add(kind, body, 6 * len(self.sessions[body]))

    def fixed(self) -> 'SensorParameters':
        """Return the same, none of which is estimated."""
        other = copy(self)
        other.kinds, other.slices, other._size = (), {}, 0
        return other

    def _add(self, kind: str, body: str, size: int) -> None:
        self.slices[kind, body] = slice(self._size, self._size + size)
        self._size += size

    def __len__(self) -> int:
        return self._size

    def rows(self, kind: str) -> Integers:
        """Return the indices of all parameters of a kind."""
        found = [np.arange(s.start, s.stop) for (own, _), s in self.slices.items() if own == kind]
        return np.concatenate(found) if found else np.zeros(0, dtype=np.int64)

    def groups(self) -> list[tuple[str, Integers]]:
        """Return parameters that share a prior's width: a kind's, but for phases and turns."""
        out = []
        for kind in self.kinds:
            rows = self.rows(kind).reshape(-1, self.each.get(kind, 1))
            parts = [rows]
            if kind == 'gains' or kind in STANDS:
                parts = np.split(rows, 2, axis=1)
            out += [(kind, part.ravel()) for part in parts]
        return out

    def prior_width(self) -> Array:
        """Return the prior standard deviation of each parameter, (Q,)."""
        width = np.zeros(len(self))
        for kind, rows in self.groups():
            width[rows] = PRIOR[kind]
        return width

    def gains_at_one_place(self) -> list[Integers]:
        """Return indices of the gains (real parts) of the sensors at each place with several."""
        out = []
        for body, table in zip(self.bodies, self.tables, strict=True):
            if (own := self.slices.get(('gains', body))) is not None:
                out += [own.start + 2 * rows for rows in clusters_of(table) if rows.size > 1]
        return out

    def rule(self) -> Array:
        """Return the information (Q, Q) of the rule for what no data determine.

        The mean of all gains is one; those of all delays, of a body's places and of what sessions
        stand by are zero.
        """
        out = np.zeros((len(self), len(self)))
        groups = [rows for kind, rows in self.groups() if kind in ('gains', 'delays')]
        for (kind, _), own in self.slices.items():
            if kind == 'places' or kind in STANDS:
                groups += list(np.arange(own.start, own.stop).reshape(-1, EACH[kind]).T)
        for rows in groups:
            out[np.ix_(rows, rows)] += 1.0 / (rows.size * BY_RULE**2)
        return out

    def by_rule(self, values: Array) -> tuple[Array, float]:
        """Return the parameters (Q,) with gains of mean modulus one, and the factor of the field.

        The mean of complex gains, which `rule` sets, is smaller by half the phases' variance.
        """
        rows = self.rows('gains').reshape(-1, 2)
        if not rows.size:
            return values, 1.0
        gain = 1.0 + values[rows[:, 0]] + 1j * values[rows[:, 1]]
        common = float(np.abs(gain).mean())
        gain = gain / common
        out = values.copy()
        out[rows[:, 0]], out[rows[:, 1]] = gain.real - 1.0, gain.imag
        return out, common

    def of(self, kind: str, body: str, values: Array) -> Array | None:
        """Return a kind's parameters of a body, for a population a row a sensor; None if fixed."""
        if (kind, body) not in self.slices:
            return None
        part = values[self.slices[kind, body]]
        return part.reshape(-1, self.each[kind]) if kind in self.each else part

    def stand(self, kind: str, body: str, session: str, values: Array) -> Array:
        """Return turn (rad) and shift (m), (6,), of a kind that sessions have, of one of them."""
        body = body if kind == 'mount' else ''
        found = self.of(kind, body, values)
        if found is None or session not in self.sessions[body]:
            return np.zeros(6)
        turn, shift = np.split(found[self.sessions[body].index(session)], 2)
        if kind == 'registration':
            shift = shift + self.pivot - Rotation.from_rotvec(turn / ARM_M).apply(self.pivot)
        return np.concatenate([turn / ARM_M, shift])

    def errors_of(self, body: str, values: Array, session: str = '') -> BodyErrors:
        """Return the errors of a body's sensors in a session for all parameters, shape (Q,)."""
        table = self.tables[self.bodies.index(body)]

        def part(kind: str, *shape: int) -> Array:
            found = self.of(kind, '' if kind in CLOCKS else body, values)
            return np.zeros(shape) if found is None else found

        count, tilts = len(table), self.of('axes', body, values)
        gains, pickups = part('gains', count, 2), part('offsets', count, 2 * self.emitters)
        turn = np.exp(-1j * part('delays', count, 1) * self.omega)
        gain = 1.0 + gains[:, 0] + 1j * gains[:, 1]
        pickup = np.asarray(self.unit_t * (pickups[:, 0::2] + 1j * pickups[:, 1::2]), complex)
        axis = table.axis if tilts is None else tilted(table.axis, tilts)
        place, lever = part('places', count, 3), part('lever_arm', 3)
        clock = [float(part(kind, 1)[0]) for kind in CLOCKS]
        offset_s = clock[0] - clock[1] * self.middle_s
        stands = (self.stand(kind, body, session, values) for kind in STANDS)
        return BodyErrors(gain, turn, axis, place, lever, pickup, offset_s, clock[1], *stands)

    def derivatives(
        self, part: Measurements, modelled: ComplexArray, by_place: ComplexArray,
        by_axis: ComplexArray, velocity: Array,
    ) -> ComplexArray:  # fmt: skip
        """Return the derivatives of fluxes by all parameters.

        ``part``: F frames of the S sensors of one body. ``modelled`` (F, S, K): modelled fluxes,
        T. ``by_place``, ``by_axis`` (F, S, 3, K): their derivatives by the sensors' positions
        (T/m) and axes (T), frame fg. ``velocity`` (F, 6): of the body, m/s and rad/s, frame fg.
        Returns (F, S, Q, K): T per unit of the parameter; zero for the parameters of other bodies.
        """
        frames, sensors, emitters = modelled.shape
        out = np.zeros((frames, sensors, len(self), emitters), complex)
        each = np.arange(sensors)
        if (own := self.slices.get(('gains', part.body))) is not None:
            out[:, each, own.start + 2 * each] = modelled
            out[:, each, own.start + 2 * each + 1] = 1j * modelled
        if (own := self.slices.get(('delays', part.body))) is not None:
            out[:, each, own.start + each] = -1j * self.omega * modelled
        if (own := self.slices.get(('offsets', part.body))) is not None:
            for k in range(emitters):
                column = own.start + 2 * (emitters * each + k)
                out[:, each, column, k] = self.unit_t
                out[:, each, column + 1, k] = 1j * self.unit_t
        if (own := self.slices.get(('axes', part.body))) is not None:
            surveyed = self.tables[self.bodies.index(part.body)].axis
            across = np.einsum('fij,stj->fsti', part.rotation, tangents(surveyed))
            tilt = np.einsum('fsik,fsti->fstk', by_axis, across, optimize=True)
            for t in range(2):
                out[:, each, own.start + 2 * each + t] = tilt[:, :, t]
        along = np.einsum('fsik,fij->fsjk', by_place, part.rotation, optimize=True)
        if (own := self.slices.get(('places', part.body))) is not None:
            for j in range(3):
                out[:, each, own.start + 3 * each + j] = along[:, :, j]
        if (own := self.slices.get(('lever_arm', part.body))) is not None:
            out[:, :, own] = along
        points, axes = part.placed()
        if (own := self.slices.get(('registration', ''))) is not None:
            first = own.start + 6 * self.sessions[''].index(part.session)
            moved = _rigid(by_place, by_axis, points - self.pivot, axes)
            out[:, :, first : first + 6] = moved
        if (own := self.slices.get(('mount', part.body))) is not None:
            first = own.start + 6 * self.sessions[part.body].index(part.session)
            tilt = np.einsum('fsik,fij->fsjk', by_axis, part.rotation, optimize=True)
            own_arms, own_axes = part.sensors.position[None], part.sensors.axis[None]
            moved = _rigid(along, tilt, own_arms, own_axes)
            out[:, :, first : first + 6] = moved
        arms = points - part.position[:, None, :]
        moving = velocity[:, None, :3] + np.cross(velocity[:, None, 3:], arms)
        rate = np.einsum('fsik,fsi->fsk', by_place, moving)
        rate += np.einsum('fsik,fsi->fsk', by_axis, np.cross(velocity[:, None, 3:], axes))
        if (own := self.slices.get(('time_offset', ''))) is not None:
            out[:, :, own.start] = -rate
        if (own := self.slices.get(('clock_rate', ''))) is not None:
            since = part.time - self.middle_s
            out[:, :, own.start] = -rate * since[:, None, None]
        return out
