"""Effects put into recorded arrays, exactly: what a diagnosis must find, or must not name.

An injection changes the readings and the optical track of a `Subject`, and says what it did.
Those in `LISTED` are of the table in `docs/interfaces.md`; those in `UNLISTED` are of no table,
with the new names that would describe them rightly, if any.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.diagnosis.prepare import build_problem
from anser_ros.diagnosis.problem import Problem
from anser_ros.diagnosis.whitening import Spread
from anser_ros.effects.saturation import compressed
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.pose_track import PoseTrack

NOISE_T = 60e-12
JITTER_M, JITTER_RAD = 0.07e-3, 0.4e-3
SIZES = {'small': 0.3, 'medium': 1.0, 'large': 3.0}
TRACK, TABLE, FIELD, EMITTER, CHANNEL, OFFSET, READING = range(7)
"""Where in the chain an injection acts; pairs are put in in this order."""
Truth = dict[str, dict[str, Any]]


@dataclass
class Subject:
    """A session's arrays, and what its fields are."""

    tool: Measurements
    reference: Measurements
    baseline: np.ndarray
    model: FieldModel
    drawn: FieldModel | None
    illumination: Dipoles

    def __post_init__(self) -> None:
        # Where the sensors truly are, whatever becomes of the optical track.
        self.rotation = self.tool.rotation
        self.centres, self.axes = self.tool.placed()
        self.field = Dipoles(self.model.positions, self.model.directions, self.model.moments)
        self.omega = 2 * np.pi * np.asarray(self.model.frequencies_hz)
        self.time = self.tool.time
        self.clean = self.read(self.centres, self.axes)

    @property
    def sensors(self) -> int:
        """Number of the tool's channels."""
        return len(self.tool.sensors)

    @property
    def emitters(self) -> int:
        """Number of emitters."""
        return int(self.omega.size)

    def clusters(self) -> list[list[int]]:
        """Rows of the tool's sensors that share a centre."""
        place = self.tool.sensors.position
        near = np.linalg.norm(place[:, None] - place[None], axis=2) < 2e-3
        return [list(rows) for rows in {tuple(np.flatnonzero(row)) for row in near}]

    def read(self, centres: np.ndarray, axes: np.ndarray, length: float = 0.0) -> np.ndarray:
        """The model's flux at centres and axes of shape (F, ..., 3)."""
        flat = centres.reshape(-1, 3)
        lengths = np.full(len(flat), length) if length else None
        return self.field.flux(flat, axes.reshape(-1, 3), lengths).reshape(*centres.shape[:-1], -1)

    def flux(self, values: np.ndarray) -> None:
        """Give the tool other readings."""
        self.tool = replace(self.tool, flux=values)

    def references(self, values: np.ndarray) -> None:
        """Give the references other readings."""
        self.reference = replace(self.reference, flux=values)

    def channel(self, row: int, values: np.ndarray) -> None:
        """Give one channel of the tool other readings."""
        flux = self.tool.flux.copy()
        flux[:, row] = values
        self.flux(flux)

    def emitter(self, coil: int, factor: np.ndarray) -> None:
        """Multiply one emitter's phasors by a factor for each frame, shape (F,)."""
        for body in ('tool', 'reference'):
            readings = getattr(self, body)
            flux = readings.flux.copy()
            own = np.interp(readings.time, self.time, factor)
            flux[:, :, coil] *= own[:, None]
            setattr(self, body, replace(readings, flux=flux))

    def mixed(self, matrix: np.ndarray) -> None:
        """Mix the emitters' phasors, row the tone that is read."""
        self.flux(self.tool.flux @ matrix.T)
        self.references(self.reference.flux @ matrix.T)

    def track(self, track: PoseTrack) -> None:
        """Give the tool another optical track."""
        position, rotation, valid = track.at(self.time, 0.25)
        self.tool = replace(
            self.tool, track=track, position=position, rotation=rotation, has_pose=valid
        )

    def problem(self) -> Problem:
        """Set up the diagnosis, as a session of these arrays would."""
        expected = float(np.hypot(NOISE_T, self.model.flux_error_t))
        return build_problem(
            (self.tool,), self.reference, self.baseline, self.model, self.drawn, Spread(expected)
        )


@dataclass(frozen=True)
class Injection:
    """One effect that can be put in.

    Attributes
    ----------
    name : str
    put : callable
        Changes a subject, with a random generator and a relative size; returns the truth.
    stage : int
    allowed : tuple of str
        Names beside the listed ones that describe it rightly.
    """

    name: str
    put: Callable[[Subject, np.random.Generator, float], Truth]
    stage: int
    allowed: tuple[str, ...] = ()


LISTED: dict[str, Injection] = {}
UNLISTED: dict[str, Injection] = {}


def _listed(stage: int) -> Callable[..., Any]:
    def add(put: Any) -> Any:
        name = put.__name__
        LISTED[name] = Injection(name, put, stage)
        return put

    return add


def _unlisted(stage: int, *allowed: str) -> Callable[..., Any]:
    def add(put: Any) -> Any:
        name = put.__name__
        UNLISTED[name] = Injection(name, put, stage, allowed)
        return put

    return add


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform size of either sign."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))) * rng.choice([-1, 1]))


def _direction(rng: np.random.Generator) -> np.ndarray:
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


def _moment(s: Subject, rng: np.random.Generator) -> float:
    """Some time well inside the session, s."""
    return float(s.time[0] + rng.uniform(0.2, 0.8) * (s.time[-1] - s.time[0]))


def _channel(s: Subject, rng: np.random.Generator) -> tuple[int, int]:
    row = int(rng.integers(s.sensors))
    return row, int(s.tool.sensors.channel[row])


def _across(s: Subject, rows: list[int], turn: np.ndarray) -> None:
    """Turn the axes of some rows in the body; ``turn`` is (3, 3) or (F, 3, 3)."""
    flux = s.tool.flux.copy()
    for row in rows:
        axes = s.rotation @ turn @ s.tool.sensors.axis[row]
        flux[:, row] += s.read(s.centres[:, row], axes) - s.clean[:, row]
    s.flux(flux)


def _moved(s: Subject, rows: list[int], offset: np.ndarray) -> None:
    """Move some rows in the body, by (3,) or (F, 3)."""
    flux = s.tool.flux.copy()
    shift = np.einsum('fij,fj->fi', s.rotation, np.broadcast_to(offset, (s.time.size, 3)))
    for row in rows:
        flux[:, row] += s.read(s.centres[:, row] + shift, s.axes[:, row]) - s.clean[:, row]
    s.flux(flux)


# --- listed effects -----------------------------------------------------------------------
@_listed(CHANNEL)
def sensor_gain(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = _channel(s, rng)
    gain, phase = 1 + size * _signed(rng, 0.006, 0.02), size * rng.uniform(-0.5, 0.5)
    s.channel(row, s.tool.flux[:, row] * gain * np.exp(1j * np.radians(phase)))
    return {'sensor_gain': {'channel': channel, 'gain': gain, 'phase_deg': phase}}


@_listed(TABLE)
def sensor_axis(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = _channel(s, rng)
    tilt = np.radians(size * rng.uniform(0.5, 1.5))
    axis = s.tool.sensors.axis[row]
    about = np.cross(axis, _direction(rng))
    about *= tilt / np.linalg.norm(about)
    _across(s, [row], Rotation.from_rotvec(about).as_matrix())
    return {'sensor_axis': {'channel': channel, 'tilt_deg': float(np.degrees(tilt))}}


@_listed(TABLE)
def cluster_axis(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    groups = sorted(s.clusters())
    rows = groups[int(rng.integers(len(groups)))]
    turn = np.radians(size * rng.uniform(0.5, 1.5)) * _direction(rng)
    _across(s, rows, Rotation.from_rotvec(turn).as_matrix())
    channels = s.tool.sensors.channel[rows].tolist()
    return {'sensor_axis': {'channels': channels, 'rotation_deg': np.degrees(turn)}}


@_listed(CHANNEL)
def sensor_polarity(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    rows = sorted(rng.choice(s.sensors, 1 + int(size > 1), replace=False).tolist())
    flux = s.tool.flux.copy()
    flux[:, rows] *= -1
    s.flux(flux)
    return {'sensor_polarity': {'channels': s.tool.sensors.channel[rows].tolist()}}


@_listed(TABLE)
def sensor_size(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    length = float(np.sqrt(size)) * rng.uniform(0.008, 0.016)
    s.flux(s.tool.flux + s.read(s.centres, s.axes, length) - s.clean)
    return {'sensor_size': {'length_m': length}}


@_listed(TRACK)
def lever_arm(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    offset = size * 1e-3 * rng.normal(size=3)
    track = s.tool.track
    turned = Rotation.from_quat(track.quaternion).apply(offset)
    s.track(PoseTrack(track.time, track.position - turned, track.quaternion))
    return {'lever_arm': {'offset_m': offset}}


@_listed(TRACK)
def registration(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    turn, shift = size * np.radians(0.25) * rng.normal(size=3), size * 7e-4 * rng.normal(size=3)
    track, rotation = s.tool.track, Rotation.from_rotvec(turn)
    turned = (rotation * Rotation.from_quat(track.quaternion)).as_quat()
    s.track(PoseTrack(track.time, rotation.apply(track.position) + shift, turned))
    return {'registration': {'rotation_deg': np.degrees(turn), 'translation_m': shift}}


@_listed(TRACK)
def time_offset(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    offset = size * _signed(rng, 0.01, 0.03)
    track = s.tool.track
    s.track(replace(track, time=track.time - offset))
    return {'time_offset': {'offset_s': offset}}


@_listed(CHANNEL)
def channel_crosstalk(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    groups = sorted(g for g in s.clusters() if len(g) > 1)
    rows = groups[int(rng.integers(len(groups)))]
    leak = size * 0.02 * rng.uniform(-1, 1, (len(rows), len(rows)))
    matrix = np.where(np.eye(len(rows), dtype=bool), 1.0, leak)
    flux = s.tool.flux.copy()
    flux[:, rows] = np.einsum('ij,fjk->fik', matrix, flux[:, rows])
    s.flux(flux)
    channels = s.tool.sensors.channel[rows].tolist()
    return {'channel_crosstalk': {'channels': channels, 'matrix': matrix}}


@_listed(EMITTER)
def coil_crosstalk(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    source, target = (int(c) for c in rng.choice(s.emitters, 2, replace=False))
    share = size * _signed(rng, 0.005, 0.02)
    matrix = np.eye(s.emitters)
    matrix[target, source] = share
    s.mixed(matrix)
    return {'coil_crosstalk': {'coils': [source, target], 'eps': share}}


@_listed(EMITTER)
def coil_drift(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    coil, amount = int(rng.integers(s.emitters)), size * _signed(rng, 0.007, 0.02)
    tau = float(rng.uniform(8, 35))
    s.emitter(coil, 1 + amount * (1 - np.exp(-s.time / tau)))
    return {'coil_drift': {'coil': coil, 'amount': amount, 'tau_s': tau}}


@_listed(OFFSET)
def pickup(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = _channel(s, rng)
    parts = size * rng.uniform(0.7e-9, 2e-9) / np.sqrt(2) * rng.normal(size=(s.emitters, 2))
    s.channel(row, s.tool.flux[:, row] + parts @ np.array([1, 1j]))
    return {'pickup': {'channel': channel, 'phasor_t': parts}}


@_listed(READING)
def saturation(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = _channel(s, rng)
    peak = float(np.abs(s.tool.flux[:, row]).sum(axis=1).max())
    full_scale = peak * rng.uniform(2.0, 3.0) / np.sqrt(size)
    shape = str(rng.choice(['cubic', 'tanh']))
    s.channel(row, compressed(s.tool.flux[:, row], 1 / full_scale**2, shape))
    return {'saturation': {'channel': channel, 'full_scale_t': full_scale}}


@_listed(EMITTER)
def phase_delay(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    delay = size * _signed(rng, 0.3e-6, 1e-6)
    s.mixed(np.diag(np.exp(-1j * s.omega * delay)))
    return {'phase_delay': {'delay_s': delay}}


@_listed(READING)
def excess_noise(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    factor = 1 + size * rng.uniform(0.8, 1.5)
    spread = NOISE_T * np.sqrt(factor**2 - 1)
    s.flux(s.tool.flux + spread * _complex(rng, s.tool.flux.shape))
    return {'excess_noise': {'factor': factor}}


@_listed(READING)
def outliers(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    hit = rng.random(s.time.size) < min(0.02 * size * rng.uniform(0.8, 1.4), 0.08)
    flux = s.tool.flux.copy()
    flux[hit] += rng.uniform(3e-9, 3e-8) * _complex(rng, flux[hit].shape)
    s.flux(flux)
    return {'outliers': {'fraction': float(hit.mean())}}


def _complex(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


# --- of no table ----------------------------------------------------------------------------
@_unlisted(EMITTER, 'coil_fluctuation')
def coil_steps(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    step = size * _signed(rng, 0.005, 0.02)
    s.emitter(int(rng.integers(s.emitters)), 1 + step * (s.time > _moment(s, rng)))
    return {}


@_unlisted(EMITTER, 'coil_fluctuation')
def coil_ripple(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    wave = np.sin(2 * np.pi * rng.uniform(0.05, 0.6) * s.time + rng.uniform(0, 6))
    s.emitter(int(rng.integers(s.emitters)), 1 + size * rng.uniform(0.005, 0.02) * wave)
    return {}


@_unlisted(EMITTER, 'coil_gain')
def coil_weaker(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    gain = 1 + size * _signed(rng, 0.005, 0.02)
    s.emitter(int(rng.integers(s.emitters)), np.full(s.time.size, gain))
    return {}


@_unlisted(EMITTER, 'coil_fluctuation')
def coil_off_for_a_while(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    start, left = _moment(s, rng), rng.uniform(0.0, 0.5)
    off = (s.time > start) & (s.time < start + size * rng.uniform(1, 2))
    s.emitter(int(rng.integers(s.emitters)), np.where(off, left, 1.0))
    return {}


@_unlisted(EMITTER, 'tool_gain_drift', 'coil_fluctuation')
def amplitude_hum(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """Mains hum on the supply, all emitters and channels alike, aliased by the frame rate."""
    wave = np.sin(2 * np.pi * rng.uniform(2.0, 9.0) * s.time + rng.uniform(0, 6))
    factor = 1 + size * rng.uniform(0.002, 0.006) * wave
    for coil in range(s.emitters):
        s.emitter(coil, factor)
    return {}


@_unlisted(OFFSET)
def additive_hum(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """A common additive tone in all channels, that comes and goes with the beat."""
    wave = np.sin(2 * np.pi * rng.uniform(2.0, 9.0) * s.time + rng.uniform(0, 6))
    phasor = size * rng.uniform(0.5e-9, 1.5e-9) * _complex(rng, (s.sensors, s.emitters))
    s.flux(s.tool.flux + wave[:, None, None] * phasor)
    return {}


@_unlisted(CHANNEL, 'sensor_gain_drift')
def gain_ripple(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    wave = np.sin(2 * np.pi * rng.uniform(0.1, 1.0) * s.time + rng.uniform(0, 6))
    s.channel(row, s.tool.flux[:, row] * (1 + size * rng.uniform(0.01, 0.03) * wave)[:, None])
    return {}


@_unlisted(CHANNEL, 'tool_gain_drift', 'tool_gain')
def gain_with_temperature(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    warm = 1 - np.exp(-s.time / rng.uniform(10, 40))
    factor = 1 + size * _signed(rng, 0.005, 0.02) * warm
    s.flux(s.tool.flux * factor[:, None, None])
    return {}


@_unlisted(CHANNEL, 'sensor_gain_drift')
def gain_steps(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    step = size * _signed(rng, 0.005, 0.02) * (s.time > _moment(s, rng))
    s.channel(row, s.tool.flux[:, row] * (1 + step)[:, None])
    return {}


@_unlisted(CHANNEL, 'tool_gain')
def common_gain(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    s.flux(s.tool.flux * (1 + size * _signed(rng, 0.004, 0.015)))
    return {}


@_unlisted(READING, 'loose_contact', 'sensor_gain_drift')
def loose_contact(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    share, left = min(0.04 * size, 0.15), rng.choice([0.0, 0.5])
    change = rng.random(s.time.size) < 0.3
    off = np.zeros(s.time.size, bool)
    for i in range(1, s.time.size):
        off[i] = off[i - 1] if not change[i] else rng.random() < share
    s.channel(row, np.where(off[:, None], left, 1.0) * s.tool.flux[:, row])
    return {}


@_unlisted(TABLE, 'loose_sensor_axis')
def loose_axis(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    about = np.cross(s.tool.sensors.axis[row], _direction(rng))
    about /= np.linalg.norm(about)
    wave = np.sin(2 * np.pi * rng.uniform(0.1, 0.8) * s.time + rng.uniform(0, 6))
    turn = np.radians(size * rng.uniform(0.4, 1.2)) * wave[:, None] * about
    _across(s, [row], Rotation.from_rotvec(turn).as_matrix())
    return {}


@_unlisted(TABLE, 'loose_sensor_position')
def bending_body(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """The last cluster gives way under gravity, so it moves with the orientation."""
    rows = sorted(s.clusters())[-1]
    pull = s.rotation.transpose(0, 2, 1) @ np.array([0.0, 0.0, -1.0])
    _moved(s, rows, size * rng.uniform(1e-3, 3e-3) * (pull - pull.mean(axis=0)))
    return {}


@_unlisted(TABLE, 'sensor_position')
def cluster_elsewhere(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    groups = sorted(s.clusters())
    _moved(s, groups[int(rng.integers(len(groups)))], size * 5e-4 * rng.normal(size=3))
    return {}


@_unlisted(TABLE, 'sensor_position')
def warm_body(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """The body is longer than it was surveyed."""
    flux, longer = s.tool.flux.copy(), size * _signed(rng, 0.01, 0.03)
    shift = s.rotation @ s.tool.sensors.position.T * longer
    flux += s.read(s.centres + shift.transpose(0, 2, 1), s.axes) - s.clean
    s.flux(flux)
    return {}


@_unlisted(READING)
def channel_iq_imbalance(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    own = s.tool.flux[:, row]
    gain, skew = size * _signed(rng, 0.005, 0.02), size * _signed(rng, 0.005, 0.02)
    s.channel(row, own.real + 1j * ((1 + gain) * own.imag + skew * np.abs(own.real)))
    return {}


@_unlisted(READING, 'tool_gain')
def conjugate_leak(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """Mixers of unequal gain in all channels: the conjugate leaks in, turned."""
    leak = size * rng.uniform(0.003, 0.01) * np.exp(1j * rng.uniform(0, 6))
    s.flux(s.tool.flux + leak * s.tool.flux.conj())
    return {}


@_unlisted(CHANNEL)
def channel_low_pass(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    corner = s.omega.max() * 30 / size
    response = 1 / (1 + 1j * s.omega / corner)
    s.channel(row, s.tool.flux[:, row] * response / np.abs(response[0]))
    return {}


@_unlisted(CHANNEL)
def channel_resonance(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    response = 1 + size * rng.uniform(0.005, 0.02) * _complex(rng, (s.emitters,))
    s.channel(row, s.tool.flux[:, row] * response)
    return {}


@_unlisted(READING)
def channel_lag(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """A channel that is smoothed in time."""
    row, _ = _channel(s, rng)
    keep, out = min(0.25 * size, 0.7), s.tool.flux[:, row].copy()
    for i in range(1, len(out)):
        out[i] = keep * out[i - 1] + (1 - keep) * s.tool.flux[i, row]
    s.channel(row, out)
    return {}


@_unlisted(READING)
def hysteresis(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """A channel whose core remembers the way that the reading came."""
    row, _ = _channel(s, rng)
    own = s.tool.flux[:, row].real
    way = np.tanh(np.gradient(own, axis=0) / np.std(np.gradient(own, axis=0), axis=0))
    s.channel(row, s.tool.flux[:, row] + size * rng.uniform(0.5e-9, 1.5e-9) * way)
    return {}


@_unlisted(READING)
def quantised(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    step = size * rng.uniform(0.6e-9, 1.5e-9)
    flux = s.tool.flux
    s.flux(step * (np.round(flux.real / step) + 1j * np.round(flux.imag / step)))
    return {}


@_unlisted(READING)
def even_order(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """A channel whose gain depends on the sign of the reading."""
    row, _ = _channel(s, rng)
    own = s.tool.flux[:, row]
    s.channel(row, own * (1 + size * rng.uniform(0.004, 0.012) * np.sign(own.real)))
    return {}


@_unlisted(CHANNEL, 'swapped_channels')
def channels_swapped(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    pair = rng.choice(s.sensors, 2, replace=False)
    flux = s.tool.flux.copy()
    flux[:, pair] = flux[:, pair[::-1]]
    s.flux(flux)
    return {}


@_unlisted(EMITTER, 'swapped_coils')
def coils_swapped(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    order = np.arange(s.emitters)
    pair = rng.choice(s.emitters, 2, replace=False)
    order[pair] = order[pair[::-1]]
    s.mixed(np.eye(s.emitters)[order])
    return {}


@_unlisted(READING, 'dead_channel')
def dead_channel(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, _ = _channel(s, rng)
    s.channel(row, NOISE_T * _complex(rng, (s.time.size, s.emitters)))
    return {}


@_unlisted(TRACK, 'optical_scale')
def optical_scale(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    track, scale = s.tool.track, 1 + size * _signed(rng, 0.003, 0.01)
    s.track(replace(track, position=track.position * scale))
    return {}


@_unlisted(TRACK, 'registration_drift', 'optical_jitter')
def registration_drift(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    track, way = s.tool.track, size * 1e-3 * rng.normal(size=3)
    s.track(
        replace(
            track,
            position=track.position
            + way * ((track.time - track.time[0]) / np.ptp(track.time))[:, None],
        )
    )
    return {}


@_unlisted(TRACK, 'registration_drift', 'optical_jitter')
def optical_knock(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """Somebody knocks the optical tracker, once."""
    track, way = s.tool.track, size * 1e-3 * rng.normal(size=3)
    after = (track.time > _moment(s, rng))[:, None]
    s.track(replace(track, position=track.position + way * after))
    return {}


@_unlisted(TRACK, 'optical_jitter')
def optical_jitter(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    track, more = s.tool.track, 1 + 2 * size
    shake = Rotation.from_rotvec(more * JITTER_RAD * rng.normal(size=(track.time.size, 3)))
    s.track(
        PoseTrack(
            track.time,
            track.position + more * JITTER_M * rng.normal(size=track.position.shape),
            (shake * Rotation.from_quat(track.quaternion)).as_quat(),
        )
    )
    return {}


@_unlisted(TRACK, 'clock_rate')
def clock_runs_slow(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    track, rate = s.tool.track, size * _signed(rng, 300e-6, 1000e-6)
    s.track(replace(track, time=track.time / (1 + rate)))
    return {}


@_unlisted(TRACK, 'stamp_jitter', 'optical_jitter')
def stamp_jitter(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    track = s.tool.track
    shaken = track.time + size * 4e-3 * rng.normal(size=track.time.size)
    s.track(replace(track, time=np.maximum.accumulate(shaken) + 1e-9 * np.arange(shaken.size)))
    return {}


@_unlisted(TRACK, 'stamp_jitter')
def clock_steps(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    track, step = s.tool.track, size * rng.uniform(0.01, 0.03)
    s.track(replace(track, time=track.time + step * (track.time > _moment(s, rng))))
    return {}


@_unlisted(FIELD)
def weak_stray_field(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """A smooth field at every tone that no board makes; the references don't see it."""
    uniform = size * 1e-9 * rng.normal(size=(3, s.emitters))
    gradient = size * 1e-8 * rng.normal(size=(3, 3, s.emitters))
    field = uniform + np.einsum('fsi,ijk->fsjk', s.centres, gradient)
    s.flux(s.tool.flux + np.einsum('fsj,fsjk->fsk', s.axes, field))
    return {}


@_unlisted(CHANNEL, 'sensor_gain')
def reference_gain(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """One reference channel's gain is off; the listed name fits it."""
    row = int(rng.integers(len(s.reference.sensors)))
    flux = s.reference.flux.copy()
    gain = 1 + size * _signed(rng, 0.01, 0.04)
    flux[:, row] *= gain
    s.references(flux)
    channel = int(s.reference.sensors.channel[row])
    return {'sensor_gain': {'channel': channel, 'gain': gain, 'phase_deg': 0.0}}


@_unlisted(CHANNEL, 'reference_changed', 'sensor_gain')
def reference_moved(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row = int(rng.integers(len(s.reference.sensors)))
    table, flux = s.reference.sensors, s.reference.flux.copy()
    place, shift = table.position[row : row + 1], size * 3e-3 * _direction(rng)
    axis = table.axis[row : row + 1]
    there = s.illumination.flux(place + shift, axis, None)
    flux[:, row] += there - s.illumination.flux(place, axis, None)
    s.references(flux)
    return {}


@_unlisted(READING, 'dead_channel')
def reference_dead(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row = int(rng.integers(len(s.reference.sensors)))
    flux = s.reference.flux.copy()
    flux[:, row] = NOISE_T * _complex(rng, flux[:, row].shape)
    s.references(flux)
    return {}


@_unlisted(CHANNEL)
def references_drift(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    """All references' gain drifts (one amplifier for all), the tool's doesn't."""
    warm = 1 + size * _signed(rng, 0.003, 0.01) * (1 - np.exp(-s.reference.time / 15))
    s.references(s.reference.flux * warm[:, None, None])
    return {}


CATALOGUE = (
    'sensor_gain', 'sensor_axis', 'sensor_polarity', 'sensor_size', 'lever_arm', 'registration',
    'time_offset', 'channel_crosstalk', 'coil_crosstalk', 'coil_drift', 'coil_moved', 'pickup',
    'saturation', 'phase_delay', 'static_metal', 'conductive_plate', 'moving_metal',
    'excess_noise', 'outliers',
)  # fmt: skip
"""The listed names."""
TOLERANCE: Mapping[str, float] = {
    'gain': 1e-3, 'offset_s': 5e-4, 'offset_m': 1e-4, 'rotation_deg': 0.05,
    'translation_m': 1e-4, 'amount': 1e-3, 'full_scale_t': 0.1,
}  # fmt: skip
"""Largest allowed error of a component; of the full scale, its share."""
