"""Models a magnet seen by an array of three-axis sensors, and its small effects.

Reciprocity: the magnet is the field generator, the sensors are the tool. An effect is a block of
small parameters, either the same few for each sensor (`per sensor`) or common to all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.physics.dipole import field_basis

Array = NDArray[np.float64]
Parameters = Mapping[str, Array]


@dataclass(frozen=True)
class Recording:
    """Holds F poses of a magnet before S three-axis sensors, frame of the optical system.

    Attributes
    ----------
    name : str
    field_t : ndarray, shape (F, S, 3)
        Flux density in each sensor's own axes, ambient field removed, T.
    sensor_m : ndarray, shape (F, S, 3)
        Stated sensor positions, m.
    sensor_rotation : ndarray, shape (F, S, 3, 3)
        Stated rotations, sensor to optical frame.
    magnet_m : ndarray, shape (F, 3)
        Stated magnet centre, m.
    magnet_rotation : ndarray, shape (F, 3, 3)
        Magnet to optical frame; the moment lies along the magnet's +z.
    stamp_s : ndarray, shape (F,)
    """

    name: str
    field_t: Array
    sensor_m: Array
    sensor_rotation: Array
    magnet_m: Array
    magnet_rotation: Array
    stamp_s: Array

    def select(self, frames: NDArray[np.generic]) -> 'Recording':
        """Return the recording of some frames only."""
        parts = {
            key: getattr(self, key)[frames]
            for key in (
                'field_t',
                'sensor_m',
                'sensor_rotation',
                'magnet_m',
                'magnet_rotation',
                'stamp_s',
            )
        }
        return replace(self, **parts)

    def with_pose(self, magnet_m: Array, magnet_rotation: Array) -> 'Recording':
        """Return the same sensors and fields, another pose of the magnet."""
        return replace(self, magnet_m=magnet_m, magnet_rotation=magnet_rotation)

    def velocity(self) -> Array:
        """Return the stated velocity of the magnet, m/s, shape (F, 3)."""
        if len(self.stamp_s) < 3 or not np.all(np.diff(self.stamp_s) > 0.0):
            return np.zeros_like(self.magnet_m)
        return np.asarray(np.gradient(self.magnet_m, self.stamp_s, axis=0))


@dataclass(frozen=True)
class Source:
    """Holds the magnet as dipoles along its z: nodes (N, 3), m, and weights (N,) of sum one."""

    nodes_m: Array
    weights: Array

    def field(self, points_m: Array) -> Array:
        """Return the field (T) per A m^2 at points (..., 3) of the magnet's own frame."""
        flat = points_m.reshape(-1, 3)
        along = np.broadcast_to([0.0, 0.0, 1.0], self.nodes_m.shape)
        basis = field_basis(flat, self.nodes_m, along)
        return np.asarray(np.einsum('pni,n->pi', basis, self.weights).reshape(points_m.shape))


def point_source() -> Source:
    """Return a source that is a single dipole."""
    return Source(np.zeros((1, 3)), np.ones(1))


@dataclass(frozen=True)
class EffectSpec:
    """Describes the parameters of one effect.

    Attributes
    ----------
    count : int
        Parameters of a sensor, or of all.
    per_sensor : bool
    spread : float
        Plausible size, the prior's standard deviation, in `unit`.
    unit : str
    meaning : str
    """

    count: int
    per_sensor: bool
    spread: float
    unit: str
    meaning: str


EFFECTS: Mapping[str, EffectSpec] = {
    'moment': EffectSpec(1, False, 0.05, '', 'strength of the magnet'),
    'sensor_gain': EffectSpec(1, True, 0.02, '', 'one gain a sensor'),
    'channel_gain': EffectSpec(3, True, 0.02, '', 'one gain an axis'),
    'sensor_axis': EffectSpec(3, True, 0.02, 'rad', 'rotation of each sensor'),
    'sensor_position': EffectSpec(3, True, 5e-4, 'm', 'each sensor sits elsewhere'),
    'channel_crosstalk': EffectSpec(6, True, 0.02, '', 'axes of a sensor leak into each other'),
    'pickup': EffectSpec(3, True, 5e-6, 'T', 'constant field of each axis'),
    'ambient': EffectSpec(3, False, 5e-6, 'T', 'constant field in the optical frame'),
    'saturation': EffectSpec(1, False, 0.05, '', 'relative loss at 10 mT, growing as its square'),
    'lever_arm': EffectSpec(3, False, 1e-3, 'm', 'magnet centre in the frame of its markers'),
    'source_axis': EffectSpec(2, False, 0.02, 'rad', 'moment not along the magnet'),
    'registration': EffectSpec(6, False, 1.0, 'm, rad', 'the whole patch sits elsewhere'),
    'source_size': EffectSpec(1, False, 1e-4, 'm^2', 'octupole of a magnet that is no point'),
    'moment_drift': EffectSpec(1, False, 1e-5, '1/s', 'strength changes with time'),
    'time_offset': EffectSpec(1, False, 0.1, 's', 'pose and field of different moments'),
}
"""Number of parameters, expected spread and unit of every effect; the spreads are priors."""
_OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Rows and columns of the six elements of a sensor's crosstalk."""
_REGISTRATION_SPREAD = np.array([2e-3] * 3 + [0.02] * 3)
"""Expected shift (m) and rotation (rad) of the patch from its stated place."""
SATURATION_SCALE_T = 1e-2
"""Flux density at which the parameter of the saturation is the relative loss, T."""


def zero(name: str, sensors: int) -> Array:
    """Return parameters of an effect that is not there, shape (S, count) or (count,)."""
    spec = EFFECTS[name]
    return np.zeros((sensors, spec.count) if spec.per_sensor else (spec.count,))


def _rotation(vectors: Array) -> Array:
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _source_field(source: Source, points: Array, octupole: float, step_m: float) -> Array:
    field = source.field(points)
    if octupole == 0.0:
        return field
    up = np.array([0.0, 0.0, step_m])
    second = source.field(points + up) - 2.0 * field + source.field(points - up)
    return np.asarray(field + octupole / step_m**2 * second)


def predict(recording: Recording, source: Source, moment: float, found: Parameters) -> Array:
    """Return the readings of every sensor, own axes, shape (F, S, 3), T.

    Parameters
    ----------
    recording : Recording
        Its fields are not used.
    source : Source
    moment : float
        A m^2.
    found : mapping
        Parameters of effects by name, as `zero` lays them out.
    """

    def of(name: str) -> Array:
        spec = EFFECTS[name]
        return found.get(name, np.zeros((1, spec.count) if spec.per_sensor else spec.count))

    turn = recording.magnet_rotation
    centre = recording.magnet_m + np.einsum('fij,j->fi', turn, of('lever_arm'))
    if 'time_offset' in found:
        centre = centre + of('time_offset')[0] * recording.velocity()
    if 'source_axis' in found:
        turn = turn @ _rotation(np.append(of('source_axis'), 0.0))
    sensor_turn = recording.sensor_rotation
    place = recording.sensor_m
    if 'registration' in found:
        shift = of('registration') * _REGISTRATION_SPREAD
        middle = place.mean(axis=1, keepdims=True)
        common = _rotation(shift[3:])
        place = (place - middle) @ common.T + middle + shift[:3]
        sensor_turn = common @ sensor_turn
    place = place + np.einsum('fsij,sj->fsi', sensor_turn, _per(of('sensor_position'), place))
    local = np.einsum('fji,fsj->fsi', turn, place - centre[:, None])
    size = float(np.median(np.linalg.norm(local, axis=2)))
    field = _source_field(source, local, float(of('source_size')[0]), 0.05 * size)
    strength = moment * (1.0 + of('moment')[0])
    if 'moment_drift' in found:
        age = recording.stamp_s - recording.stamp_s.mean()
        field = field * (1.0 + of('moment_drift')[0] * age)[:, None, None]
    world = strength * np.einsum('fij,fsj->fsi', turn, field) + of('ambient')
    if 'sensor_axis' in found:
        sensor_turn = sensor_turn @ _rotation(of('sensor_axis'))
    return _readings(np.einsum('fsji,fsj->fsi', sensor_turn, world), found)


def _per(values: Array, place: Array) -> Array:
    return np.asarray(np.broadcast_to(values, (place.shape[1], 3)))


def _readings(field: Array, found: Parameters) -> Array:
    """What the sensors make of the field along their axes, (F, S, 3)."""
    reading = field
    if 'channel_crosstalk' in found:
        leak = np.zeros((*found['channel_crosstalk'].shape[:1], 3, 3))
        for k, (row, column) in enumerate(_OFF_DIAGONAL):
            leak[:, row, column] = found['channel_crosstalk'][:, k]
        reading = reading + np.einsum('sij,fsj->fsi', leak, field)
    for name in ('sensor_gain', 'channel_gain'):
        if name in found:
            reading = reading * (1.0 + found[name])
    if 'saturation' in found:
        share = (reading / SATURATION_SCALE_T) ** 2
        reading = reading * (1.0 - found['saturation'][0] * share)
    if 'pickup' in found:
        reading = reading + found['pickup']
    return np.asarray(reading)


def columns(
    recording: Recording, source: Source, moment: float, found: Parameters, name: str
) -> Array:
    """Return the derivatives of `predict` by the parameters of one effect, per spread.

    Returns
    -------
    ndarray, shape (F, S, 3, n)
        n = count, or S times count for an effect of each sensor (sensor by sensor).
    """
    spec, sensors = EFFECTS[name], recording.field_t.shape[1]
    here = np.asarray(found.get(name, zero(name, sensors)))
    step, parts = 1e-3 * spec.spread, []
    for k in range(spec.count):
        change = np.zeros_like(here)
        change[..., k] = step
        ends = [
            predict(recording, source, moment, {**found, name: here + sign * change})
            for sign in (1.0, -1.0)
        ]
        parts.append((ends[0] - ends[1]) * (0.5 * spec.spread / step))
    derivative = np.stack(parts, axis=-1)
    if not spec.per_sensor:
        return derivative
    own = np.eye(sensors)
    spread = np.einsum('fsik,st->fsitk', derivative, own)
    return np.asarray(spread.reshape(*derivative.shape[:3], -1))


def add(found: Parameters, names: Sequence[str], step: Array, sensors: int) -> dict[str, Array]:
    """Return parameters after a step in units of the spreads, in the order of `names`."""
    out, at = {key: np.asarray(value) for key, value in found.items()}, 0
    for name in names:
        here = out.get(name, zero(name, sensors))
        part = step[at : at + here.size].reshape(here.shape) * EFFECTS[name].spread
        out[name] = here + part
        at += here.size
    return out
