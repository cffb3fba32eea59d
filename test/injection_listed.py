"""The effects of the table in `docs/interfaces.md`, put into recorded arrays exactly."""

from dataclasses import replace

import numpy as np
from injection_subject import (
    CHANNEL,
    EMITTER,
    NOISE_T,
    OFFSET,
    READING,
    TABLE,
    TRACK,
    Subject,
    Truth,
    a_channel,
    a_direction,
    complex_normal,
    listed,
    signed,
    turn_axes,
)
from scipy.spatial.transform import Rotation

from anser_ros.effects.saturation import compressed
from anser_ros.physics.pose_track import PoseTrack


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
