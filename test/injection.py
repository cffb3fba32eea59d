"""Effects put into recorded arrays, exactly: what a diagnosis must find, or must not name.

An injection changes the readings and the optical track of a `Subject`, and says what it did.
Those in `LISTED` are of the table in `docs/interfaces.md`; those in `UNLISTED` are of no table,
with the new names that would describe them rightly, if any.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from injection_subject import (
    CHANNEL,
    EMITTER,
    FIELD,
    JITTER_M,
    JITTER_RAD,
    LISTED,
    NOISE_T,
    OFFSET,
    READING,
    SIZES,
    TABLE,
    TRACK,
    UNLISTED,
    Subject,
    Truth,
    a_channel,
    a_direction,
    a_moment,
    complex_normal,
    listed,
    move_coils,
    signed,
    turn_axes,
    unlisted,
)
from scipy.spatial.transform import Rotation

from anser_ros.effects.channels import compressed
from anser_ros.physics.pose_track import PoseTrack

__all__ = ['CATALOGUE', 'LISTED', 'SIZES', 'TOLERANCE', 'UNLISTED']

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


@listed(CHANNEL)
def sensor_gain(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = a_channel(s, rng)
    gain, phase = 1 + size * signed(rng, 0.006, 0.02), size * rng.uniform(-0.5, 0.5)
    s.channel(row, s.tool.flux[:, row] * gain * np.exp(1j * np.radians(phase)))
    return {'sensor_gain': {'channel': channel, 'gain': gain, 'phase_deg': phase}}


@listed(TABLE)
def sensor_axis(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = a_channel(s, rng)
    tilt = np.radians(size * rng.uniform(0.5, 1.5))
    axis = s.tool.sensors.axis[row]
    about = np.cross(axis, a_direction(rng))
    about *= tilt / np.linalg.norm(about)
    turn_axes(s, [row], Rotation.from_rotvec(about).as_matrix())
    return {'sensor_axis': {'channel': channel, 'tilt_deg': float(np.degrees(tilt))}}


@listed(TABLE)
def cluster_axis(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    groups = sorted(s.clusters())
    rows = groups[int(rng.integers(len(groups)))]
    turn = np.radians(size * rng.uniform(0.5, 1.5)) * a_direction(rng)
    turn_axes(s, rows, Rotation.from_rotvec(turn).as_matrix())
    channels = s.tool.sensors.channel[rows].tolist()
    return {'sensor_axis': {'channels': channels, 'rotation_deg': np.degrees(turn)}}


@listed(CHANNEL)
def sensor_polarity(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    rows = sorted(rng.choice(s.sensors, 1 + int(size > 1), replace=False).tolist())
    s.channel(rows, -s.tool.flux[:, rows])
    return {'sensor_polarity': {'channels': s.tool.sensors.channel[rows].tolist()}}


@listed(TABLE)
def sensor_size(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    length = float(np.sqrt(size)) * rng.uniform(0.008, 0.016)
    s.flux(s.tool.flux + s.read(s.centres, s.axes, length) - s.clean)
    return {'sensor_size': {'length_m': length}}


@listed(TRACK)
def lever_arm(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    offset = size * 1e-3 * rng.normal(size=3)
    track = s.tool.track
    turned = Rotation.from_quat(track.quaternion).apply(offset)
    s.track(PoseTrack(track.time, track.position - turned, track.quaternion))
    return {'lever_arm': {'offset_m': offset}}


@listed(TRACK)
def registration(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    turn, shift = size * np.radians(0.25) * rng.normal(size=3), size * 7e-4 * rng.normal(size=3)
    track, rotation = s.tool.track, Rotation.from_rotvec(turn)
    turned = (rotation * Rotation.from_quat(track.quaternion)).as_quat()
    s.track(PoseTrack(track.time, rotation.apply(track.position) + shift, turned))
    return {'registration': {'rotation_deg': np.degrees(turn), 'translation_m': shift}}


@listed(TRACK)
def time_offset(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    offset = size * signed(rng, 0.01, 0.03)
    track = s.tool.track
    s.track(replace(track, time=track.time - offset))
    return {'time_offset': {'offset_s': offset}}


@listed(CHANNEL)
def channel_crosstalk(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    groups = sorted(g for g in s.clusters() if len(g) > 1)
    rows = groups[int(rng.integers(len(groups)))]
    leak = size * 0.02 * rng.uniform(-1, 1, (len(rows), len(rows)))
    matrix = np.where(np.eye(len(rows), dtype=bool), 1.0, leak)
    s.channel(rows, np.einsum('ij,fjk->fik', matrix, s.tool.flux[:, rows]))
    channels = s.tool.sensors.channel[rows].tolist()
    return {'channel_crosstalk': {'channels': channels, 'matrix': matrix}}


@listed(EMITTER)
def coil_crosstalk(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    source, target = (int(c) for c in rng.choice(s.emitters, 2, replace=False))
    share = size * signed(rng, 0.005, 0.02)
    matrix = np.eye(s.emitters)
    matrix[target, source] = share
    s.mixed(matrix)
    return {'coil_crosstalk': {'coils': [source, target], 'eps': share}}


@listed(EMITTER)
def coil_drift(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    coil, amount = int(rng.integers(s.emitters)), size * signed(rng, 0.007, 0.02)
    tau = float(rng.uniform(8, 35))
    s.emitter(coil, 1 + amount * (1 - np.exp(-s.time / tau)))
    return {'coil_drift': {'coil': coil, 'amount': amount, 'tau_s': tau}}


@listed(OFFSET)
def pickup(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = a_channel(s, rng)
    parts = size * rng.uniform(0.7e-9, 2e-9) / np.sqrt(2) * rng.normal(size=(s.emitters, 2))
    s.channel(row, s.tool.flux[:, row] + parts @ np.array([1, 1j]))
    return {'pickup': {'channel': channel, 'phasor_t': parts}}


@listed(READING)
def saturation(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    row, channel = a_channel(s, rng)
    peak = float(np.abs(s.tool.flux[:, row]).sum(axis=1).max())
    full_scale = peak * rng.uniform(2.0, 3.0) / np.sqrt(size)
    shape = str(rng.choice(['cubic', 'tanh']))
    s.channel(row, compressed(s.tool.flux[:, row], 1 / full_scale**2, shape))
    return {'saturation': {'channel': channel, 'full_scale_t': full_scale}}


@listed(EMITTER)
def phase_delay(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    delay = size * signed(rng, 0.3e-6, 1e-6)
    s.mixed(np.diag(np.exp(-1j * s.omega * delay)))
    return {'phase_delay': {'delay_s': delay}}


@listed(READING)
def excess_noise(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    factor = 1 + size * rng.uniform(0.8, 1.5)
    spread = NOISE_T * np.sqrt(factor**2 - 1)
    s.flux(s.tool.flux + spread * complex_normal(rng, s.tool.flux.shape))
    return {'excess_noise': {'factor': factor}}


@listed(READING)
def outliers(s: Subject, rng: np.random.Generator, size: float) -> Truth:
    hit = rng.random(s.time.size) < min(0.02 * size * rng.uniform(0.8, 1.4), 0.08)
    flux = s.tool.flux.copy()
    flux[hit] += rng.uniform(3e-9, 3e-8) * complex_normal(rng, flux[hit].shape)
    s.flux(flux)
    return {'outliers': {'fraction': float(hit.mean())}}


@unlisted(EMITTER, 'coil_fluctuation')
def coil_steps(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    step = size * signed(rng, 0.005, 0.02)
    s.emitter(int(rng.integers(s.emitters)), 1 + step * (s.time > a_moment(s, rng)))


@unlisted(EMITTER, 'coil_fluctuation')
def coil_ripple(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    wave = np.sin(2 * np.pi * rng.uniform(0.05, 0.6) * s.time + rng.uniform(0, 6))
    s.emitter(int(rng.integers(s.emitters)), 1 + size * rng.uniform(0.005, 0.02) * wave)


@unlisted(EMITTER, 'coil_gain')
def coil_weaker(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    gain = 1 + size * signed(rng, 0.005, 0.02)
    s.emitter(int(rng.integers(s.emitters)), np.full(s.time.size, gain))


@unlisted(EMITTER, 'coil_fluctuation')
def coil_off_for_a_while(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    start, left = a_moment(s, rng), rng.uniform(0.0, 0.5)
    off = (s.time > start) & (s.time < start + size * rng.uniform(1, 2))
    s.emitter(int(rng.integers(s.emitters)), np.where(off, left, 1.0))


@unlisted(EMITTER, 'tool_gain_drift', 'coil_fluctuation')
def amplitude_hum(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """Mains hum on the supply, all emitters and channels alike, aliased by the frame rate."""
    wave = np.sin(2 * np.pi * rng.uniform(2.0, 9.0) * s.time + rng.uniform(0, 6))
    factor = 1 + size * rng.uniform(0.002, 0.006) * wave
    for coil in range(s.emitters):
        s.emitter(coil, factor)


@unlisted(OFFSET)
def additive_hum(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """A common additive tone in all channels, that comes and goes with the beat."""
    wave = np.sin(2 * np.pi * rng.uniform(2.0, 9.0) * s.time + rng.uniform(0, 6))
    phasor = size * rng.uniform(0.5e-9, 1.5e-9) * complex_normal(rng, (s.sensors, s.emitters))
    s.flux(s.tool.flux + wave[:, None, None] * phasor)


@unlisted(CHANNEL, 'sensor_gain_drift')
def gain_ripple(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    wave = np.sin(2 * np.pi * rng.uniform(0.1, 1.0) * s.time + rng.uniform(0, 6))
    s.channel(row, s.tool.flux[:, row] * (1 + size * rng.uniform(0.01, 0.03) * wave)[:, None])


@unlisted(CHANNEL, 'tool_gain_drift', 'tool_gain')
def gain_with_temperature(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    warm = 1 - np.exp(-s.time / rng.uniform(10, 40))
    factor = 1 + size * signed(rng, 0.005, 0.02) * warm
    s.flux(s.tool.flux * factor[:, None, None])


@unlisted(CHANNEL, 'sensor_gain_drift')
def gain_steps(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    step = size * signed(rng, 0.005, 0.02) * (s.time > a_moment(s, rng))
    s.channel(row, s.tool.flux[:, row] * (1 + step)[:, None])


@unlisted(CHANNEL, 'tool_gain')
def common_gain(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    s.flux(s.tool.flux * (1 + size * signed(rng, 0.004, 0.015)))


@unlisted(READING, 'loose_contact', 'sensor_gain_drift')
def loose_contact(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    share, left = min(0.04 * size, 0.15), rng.choice([0.0, 0.5])
    change = rng.random(s.time.size) < 0.3
    off = np.zeros(s.time.size, bool)
    for i in range(1, s.time.size):
        off[i] = off[i - 1] if not change[i] else rng.random() < share
    s.channel(row, np.where(off[:, None], left, 1.0) * s.tool.flux[:, row])


@unlisted(TABLE, 'loose_sensor_axis')
def loose_axis(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    about = np.cross(s.tool.sensors.axis[row], a_direction(rng))
    about /= np.linalg.norm(about)
    wave = np.sin(2 * np.pi * rng.uniform(0.1, 0.8) * s.time + rng.uniform(0, 6))
    turn = np.radians(size * rng.uniform(0.4, 1.2)) * wave[:, None] * about
    turn_axes(s, [row], Rotation.from_rotvec(turn).as_matrix())


@unlisted(TABLE, 'loose_sensor_position')
def bending_body(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """The last cluster gives way under gravity, so it moves with the orientation."""
    rows = sorted(s.clusters())[-1]
    pull = s.rotation.transpose(0, 2, 1) @ np.array([0.0, 0.0, -1.0])
    move_coils(s, rows, size * rng.uniform(1e-3, 3e-3) * (pull - pull.mean(axis=0)))


@unlisted(TABLE, 'sensor_position')
def cluster_elsewhere(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    groups = sorted(s.clusters())
    move_coils(s, groups[int(rng.integers(len(groups)))], size * 5e-4 * rng.normal(size=3))


@unlisted(TABLE, 'sensor_position')
def warm_body(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """The body is longer than it was surveyed."""
    longer = size * signed(rng, 0.01, 0.03)
    shift = s.rotation @ s.tool.sensors.position.T * longer
    s.flux(s.tool.flux + s.read(s.centres + shift.transpose(0, 2, 1), s.axes) - s.clean)


@unlisted(READING)
def channel_iq_imbalance(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    own = s.tool.flux[:, row]
    gain, skew = size * signed(rng, 0.005, 0.02), size * signed(rng, 0.005, 0.02)
    s.channel(row, own.real + 1j * ((1 + gain) * own.imag + skew * np.abs(own.real)))


@unlisted(READING, 'tool_gain')
def conjugate_leak(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """Mixers of unequal gain in all channels: the conjugate leaks in, turned."""
    leak = size * rng.uniform(0.003, 0.01) * np.exp(1j * rng.uniform(0, 6))
    s.flux(s.tool.flux + leak * s.tool.flux.conj())


@unlisted(CHANNEL)
def channel_low_pass(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    corner = s.omega.max() * 30 / size
    response = 1 / (1 + 1j * s.omega / corner)
    s.channel(row, s.tool.flux[:, row] * response / np.abs(response[0]))


@unlisted(CHANNEL)
def channel_resonance(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    response = 1 + size * rng.uniform(0.005, 0.02) * complex_normal(rng, (s.emitters,))
    s.channel(row, s.tool.flux[:, row] * response)


@unlisted(READING)
def channel_lag(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """A channel that is smoothed in time."""
    row, _ = a_channel(s, rng)
    keep, out = min(0.25 * size, 0.7), s.tool.flux[:, row].copy()
    for i in range(1, len(out)):
        out[i] = keep * out[i - 1] + (1 - keep) * s.tool.flux[i, row]
    s.channel(row, out)


@unlisted(READING)
def hysteresis(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """A channel whose core remembers the way that the reading came."""
    row, _ = a_channel(s, rng)
    own = s.tool.flux[:, row].real
    way = np.tanh(np.gradient(own, axis=0) / np.std(np.gradient(own, axis=0), axis=0))
    s.channel(row, s.tool.flux[:, row] + size * rng.uniform(0.5e-9, 1.5e-9) * way)


@unlisted(READING)
def quantised(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    step = size * rng.uniform(0.6e-9, 1.5e-9)
    flux = s.tool.flux
    s.flux(step * (np.round(flux.real / step) + 1j * np.round(flux.imag / step)))


@unlisted(READING)
def even_order(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """A channel whose gain depends on the sign of the reading."""
    row, _ = a_channel(s, rng)
    own = s.tool.flux[:, row]
    s.channel(row, own * (1 + size * rng.uniform(0.004, 0.012) * np.sign(own.real)))


@unlisted(CHANNEL, 'swapped_channels')
def channels_swapped(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    pair = rng.choice(s.sensors, 2, replace=False)
    s.channel(pair, s.tool.flux[:, pair[::-1]])


@unlisted(EMITTER, 'swapped_coils')
def coils_swapped(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    order = np.arange(s.emitters)
    pair = rng.choice(s.emitters, 2, replace=False)
    order[pair] = order[pair[::-1]]
    s.mixed(np.eye(s.emitters)[order])


@unlisted(READING, 'dead_channel')
def dead_channel(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row, _ = a_channel(s, rng)
    s.channel(row, NOISE_T * complex_normal(rng, (s.time.size, s.emitters)))


@unlisted(TRACK, 'optical_scale')
def optical_scale(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    track, scale = s.tool.track, 1 + size * signed(rng, 0.003, 0.01)
    s.track(replace(track, position=track.position * scale))


@unlisted(TRACK, 'registration_drift', 'optical_jitter')
def registration_drift(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    track, way = s.tool.track, size * 1e-3 * rng.normal(size=3)
    share = ((track.time - track.time[0]) / np.ptp(track.time))[:, None]
    s.track(replace(track, position=track.position + way * share))


@unlisted(TRACK, 'registration_drift', 'optical_jitter')
def optical_knock(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """Somebody knocks the optical tracker, once."""
    track, way = s.tool.track, size * 1e-3 * rng.normal(size=3)
    after = (track.time > a_moment(s, rng))[:, None]
    s.track(replace(track, position=track.position + way * after))


@unlisted(TRACK, 'optical_jitter')
def optical_jitter(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    track, more = s.tool.track, 1 + 2 * size
    shake = Rotation.from_rotvec(more * JITTER_RAD * rng.normal(size=(track.time.size, 3)))
    shaken = track.position + more * JITTER_M * rng.normal(size=track.position.shape)
    turned = (shake * Rotation.from_quat(track.quaternion)).as_quat()
    s.track(PoseTrack(track.time, shaken, turned))


@unlisted(TRACK, 'clock_rate')
def clock_runs_slow(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    track, rate = s.tool.track, size * signed(rng, 300e-6, 1000e-6)
    s.track(replace(track, time=track.time / (1 + rate)))


@unlisted(TRACK, 'stamp_jitter', 'optical_jitter')
def stamp_jitter(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    track = s.tool.track
    shaken = track.time + size * 4e-3 * rng.normal(size=track.time.size)
    s.track(replace(track, time=np.maximum.accumulate(shaken) + 1e-9 * np.arange(shaken.size)))


@unlisted(TRACK, 'stamp_jitter')
def clock_steps(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    track, step = s.tool.track, size * rng.uniform(0.01, 0.03)
    s.track(replace(track, time=track.time + step * (track.time > a_moment(s, rng))))


@unlisted(FIELD)
def weak_stray_field(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """A smooth field at every tone that no board makes; the references don't see it."""
    uniform = size * 1e-9 * rng.normal(size=(3, s.emitters))
    gradient = size * 1e-8 * rng.normal(size=(3, 3, s.emitters))
    field = uniform + np.einsum('fsi,ijk->fsjk', s.centres, gradient)
    s.flux(s.tool.flux + np.einsum('fsj,fsjk->fsk', s.axes, field))


@unlisted(CHANNEL, 'sensor_gain')
def reference_gain(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """One reference channel's gain is off; the listed name fits it."""
    row = int(rng.integers(len(s.reference.sensors)))
    gain = 1 + size * signed(rng, 0.01, 0.04)
    s.reference_channel(row, s.reference.flux[:, row] * gain)
    channel = int(s.reference.sensors.channel[row])
    return {'sensor_gain': {'channel': channel, 'gain': gain, 'phase_deg': 0.0}}


@unlisted(CHANNEL, 'reference_changed', 'sensor_gain')
def reference_moved(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row = int(rng.integers(len(s.reference.sensors)))
    table = s.reference.sensors
    place, shift = table.position[row : row + 1], size * 3e-3 * a_direction(rng)
    axis = table.axis[row : row + 1]
    there = s.illumination.flux(place + shift, axis, None)
    change = there - s.illumination.flux(place, axis, None)
    s.reference_channel(row, s.reference.flux[:, row] + change)


@unlisted(READING, 'dead_channel')
def reference_dead(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    row = int(rng.integers(len(s.reference.sensors)))
    s.reference_channel(row, NOISE_T * complex_normal(rng, s.reference.flux[:, row].shape))


@unlisted(CHANNEL)
def references_drift(s: Subject, rng: np.random.Generator, size: float) -> Truth | None:
    """All references' gain drifts (one amplifier for all), the tool's doesn't."""
    warm = 1 + size * signed(rng, 0.003, 0.01) * (1 - np.exp(-s.reference.time / 15))
    s.references(s.reference.flux * warm[:, None, None])
