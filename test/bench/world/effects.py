"""What can go wrong with instruments, each of a random size.

Every function changes a laboratory and returns what it did, in the words and units of the list of
effect names where the effect has one there.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

SAMPLES, RATE_HZ = 1600, 40_000.0


def _sign(rng):
    return float(rng.choice([-1.0, 1.0]))


def _direction(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def _cluster(lab, rng):
    """Rows of one triaxial cluster of the tool."""
    return 3 * int(rng.integers(len(lab.tool.channel) // 3)) + np.arange(3)


def _tool_channel(lab, rng):
    return int(rng.choice(lab.tool.channel))


def _emitter(lab, rng):
    return int(rng.integers(lab.board.omega.size))


def _on_channel(lab, channel, change):
    """Let ``change(lab, time, flux (F, K)) -> flux`` act on one channel."""

    def apply(lab, time, channels, flux):
        row = np.flatnonzero(np.asarray(channels) == channel)
        if row.size:
            flux = flux.copy()
            flux[:, row[0]] = change(lab, time, flux[:, row[0]])
        return flux

    lab.on_flux.append(apply)


def sensor_gain(lab, rng):
    """One channel's complex gain."""
    channel = _tool_channel(lab, rng)
    gain, phase = 1 + _sign(rng) * rng.uniform(0.01, 0.04), rng.uniform(-1.0, 1.0)
    factor = gain * np.exp(1j * np.radians(phase))
    _on_channel(lab, channel, lambda lab, time, flux: factor * flux)
    return {'channel': channel, 'gain': gain, 'phase_deg': phase}


def sensor_axis(lab, rng):
    """One axis tilted."""
    row = int(rng.integers(len(lab.tool.channel)))
    angle = rng.uniform(0.5, 3.0)
    axis = lab.tool.axis.copy()
    across = np.cross(axis[row], _direction(rng))
    across *= np.radians(angle) / np.linalg.norm(across)
    axis[row] = Rotation.from_rotvec(across).apply(axis[row])
    lab.tool = replace(lab.tool, axis=axis)
    return {'channel': int(lab.tool.channel[row]), 'tilt_deg': angle, 'axis': axis[row].tolist()}


def cluster_axis(lab, rng):
    """A whole cluster turned in the tool."""
    rows, turn = _cluster(lab, rng), rng.uniform(0.5, 3.0) * _direction(rng)
    axis = lab.tool.axis.copy()
    axis[rows] = Rotation.from_rotvec(np.radians(turn)).apply(axis[rows])
    lab.tool = replace(lab.tool, axis=axis)
    return {'channels': lab.tool.channel[rows].tolist(), 'rotation_deg': turn.tolist()}


def sensor_polarity(lab, rng):
    """One or two channels wired the other way round."""
    count = int(rng.integers(1, 3))
    channels = sorted(rng.choice(lab.tool.channel, count, replace=False).tolist())
    for channel in channels:
        _on_channel(lab, channel, lambda lab, time, flux: -flux)
    return {'channels': channels}


def sensor_size(lab, rng):
    """The tool's coils are longer than the setup says."""
    length = float(lab.tool.length[0]) + rng.uniform(0.007, 0.012)
    lab.tool = replace(lab.tool, length=np.full(len(lab.tool.channel), length))
    return {'length_m': length}


def lever_arm(lab, rng):
    """All sensors elsewhere in the body."""
    offset = rng.uniform(0.5e-3, 2e-3) * _direction(rng)
    lab.tool = replace(lab.tool, place=lab.tool.place + offset)
    return {'offset_m': offset.tolist()}


def registration(lab, rng):
    """The optical frame is not the board's: optical = R fg + t."""
    turn = rng.uniform(0.15, 0.7) * _direction(rng)
    shift = rng.uniform(0.5e-3, 1.8e-3) * _direction(rng)
    matrix = Rotation.from_rotvec(np.radians(turn)).as_matrix()
    lab.on_optical.append(lambda t, p, r: (t, p @ matrix.T + shift, matrix @ r))
    return {'rotation_deg': turn.tolist(), 'translation_m': shift.tolist()}


def time_offset(lab, rng):
    """At flux stamp t the optical pose stamped t - offset applies."""
    offset = _sign(rng) * rng.uniform(0.010, 0.080)
    lab.on_optical.append(lambda t, p, r: (t - offset, p, r))
    return {'offset_s': offset}


def channel_crosstalk(lab, rng):
    """The three channels of a cluster leak into each other."""
    rows, eps = _cluster(lab, rng), rng.uniform(0.015, 0.05)
    matrix = np.eye(3) + eps * rng.uniform(-1, 1, (3, 3)) * (1 - np.eye(3))
    channels = lab.tool.channel[rows].tolist()

    def leak(lab, time, listed, flux):
        if channels[0] not in listed:
            return flux
        flux = flux.copy()
        flux[:, rows] = np.einsum('ab,fbk->fak', matrix, flux[:, rows])
        return flux

    lab.on_flux.append(leak)
    return {'channels': channels, 'matrix': matrix.tolist()}


def coil_crosstalk(lab, rng):
    """The second coil's tone is read with a share of the first one's field."""
    source, target = (int(v) for v in rng.choice(lab.board.omega.size, 2, replace=False))
    eps = _sign(rng) * rng.uniform(0.01, 0.05)

    def leak(lab, time, channels, flux):
        flux = flux.copy()
        flux[..., target] += eps * flux[..., source]
        return flux

    lab.on_flux.insert(0, leak)
    return {'coils': [source, target], 'eps': eps}


def _strength(lab, coil, curve):
    def change(lab, time, channels, flux):
        flux = flux.copy()
        flux[..., coil] *= curve(np.asarray(time))[:, None]
        return flux

    lab.on_flux.insert(0, change)


def coil_drift(lab, rng):
    """An emitter warms up."""
    coil, amount = _emitter(lab, rng), _sign(rng) * rng.uniform(0.01, 0.04)
    tau = float(np.exp(rng.uniform(np.log(6), np.log(40))))
    _strength(lab, coil, lambda t: 1 + amount * (1 - np.exp(-np.maximum(t, 0) / tau)))
    return {'coil': coil, 'amount': amount, 'tau_s': tau}


def coil_moved(lab, rng):
    """An emitter is elsewhere than when the board was calibrated."""
    coil, shift = _emitter(lab, rng), rng.uniform(0.5e-3, 2e-3) * _direction(rng)
    lab.paths[coil] = lab.paths[coil] + shift
    return {'coil': coil, 'shift_m': shift.tolist()}


def pickup(lab, rng):
    """A constant phasor is added to a channel."""
    channel, size = _tool_channel(lab, rng), rng.uniform(1e-9, 5e-9)
    phasor = rng.normal(size=(lab.board.omega.size, 2)) @ np.array([1.0, 1.0j])
    phasor *= size / np.sqrt(np.mean(np.abs(phasor) ** 2))
    _on_channel(lab, channel, lambda lab, time, flux: flux + phasor)
    return {'channel': channel, 'rms_t': size}


def saturation(lab, rng):
    """An amplifier that compresses the sum of all tones, sample by sample."""
    channel, reserve = _tool_channel(lab, rng), rng.uniform(1.0, 2.2)
    truth = {'channel': channel, 'full_scale_t': None}
    phases = np.exp(2j * np.pi * rng.uniform(size=lab.board.omega.size))
    clock = np.arange(SAMPLES) / RATE_HZ
    tones = np.exp(1j * lab.board.omega[:, None] * clock) * phases[:, None]
    design = np.concatenate([tones.real, -tones.imag])
    solve = np.linalg.pinv(design.T)

    def compress(lab, time, flux):
        full = reserve * np.abs(flux).sum(axis=1).max()
        truth['full_scale_t'] = float(full)
        samples = np.concatenate([flux.real, flux.imag], axis=1) @ design
        found = (full * np.tanh(samples / full)) @ solve.T
        return found[:, : flux.shape[1]] + 1j * found[:, flux.shape[1] :]

    _on_channel(lab, channel, compress)
    return truth


def phase_delay(lab, rng):
    """A common delay of the acquisition."""
    delay = _sign(rng) * rng.uniform(0.3e-6, 3e-6)
    turn = np.exp(-1j * lab.board.omega * delay)
    lab.on_flux.append(lambda lab, time, channels, flux: flux * turn)
    return {'delay_s': delay}


def excess_noise(lab, rng):
    """More noise in all channels."""
    lab.noise[-1] = rng.uniform(2.0, 4.0)
    return {'factor': lab.noise[-1]}


def channel_noise(lab, rng):
    """More noise in one channel."""
    channel = _tool_channel(lab, rng)
    lab.noise[channel] = rng.uniform(3.0, 5.0)
    return {'factor': lab.noise[channel], 'channels': [channel]}


def outliers(lab, rng):
    """Frames of the tool that fit no model."""
    fraction = rng.uniform(0.02, 0.05)
    seed = int(rng.integers(2**31))

    def spoil(lab, time, channels, flux):
        if lab.tool.channel[0] not in channels:
            return flux
        draw = np.random.default_rng(seed)
        bad = draw.uniform(size=len(flux)) < fraction
        size = np.sqrt(np.mean(np.abs(flux) ** 2)) * draw.uniform(0.02, 0.3, len(flux))
        wrong = draw.normal(size=(*flux.shape, 2)) @ np.array([1.0, 0.3j])
        return flux + (bad * size)[:, None, None] * wrong

    lab.on_flux.append(spoil)
    return {'fraction': fraction}
