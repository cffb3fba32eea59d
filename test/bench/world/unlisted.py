"""Effects that no list of names holds, and what a careful diagnosis may call them."""

import numpy as np
from effects import _emitter, _on_channel, _sign, _strength, _tool_channel
from scipy.spatial.transform import Rotation


def coil_step(lab, rng):
    """An emitter's strength jumps during the session."""
    coil, at = _emitter(lab, rng), rng.uniform(8, 32)
    amount = _sign(rng) * rng.uniform(0.008, 0.03)
    _strength(lab, coil, lambda t: 1 + amount * (t > at))
    return {'coil': coil, 'amount': amount, 't_s': at}


def loose_contact(lab, rng):
    """A channel loses part of its signal now and then."""
    channel = _tool_channel(lab, rng)
    starts = np.sort(rng.uniform(1, 38, int(rng.integers(4, 10))))
    spells = [(float(s), float(s + rng.exponential(1.0) + 0.1)) for s in starts]
    losses = rng.uniform(0.01, 0.2, len(spells))

    def lose(lab, time, flux):
        gain = np.ones(len(flux))
        for (start, end), loss in zip(spells, losses, strict=True):
            gain = np.where((time >= start) & (time < end), 1 - loss, gain)
        return gain[:, None] * flux

    _on_channel(lab, channel, lose)
    return {'channel': channel, 'spells_s': spells, 'losses': losses.tolist()}


def iq_imbalance(lab, rng):
    """A channel's quadrature path has another gain, and is not quite at a right angle."""
    channel = _tool_channel(lab, rng)
    gain, angle = rng.uniform(0.01, 0.04), np.radians(rng.uniform(0.5, 3.0))

    def mix(lab, time, flux):
        return flux.real + 1j * ((1 + gain) * flux.imag + np.sin(angle) * flux.real)

    _on_channel(lab, channel, mix)
    return {'channel': channel, 'gain': gain, 'angle_deg': float(np.degrees(angle))}


def optical_scale(lab, rng):
    """The optical tracker's millimetre is too long or too short."""
    scale = 1 + _sign(rng) * rng.uniform(0.003, 0.006)
    lab.on_optical.append(lambda t, p, r: (t, scale * p, r))
    return {'scale': scale}


def registration_drift(lab, rng):
    """The optical tracker, or its reference, sags during the session."""
    turn = np.radians(rng.uniform(0.1, 0.4)) * rng.normal(size=3) / np.sqrt(3)
    shift = rng.uniform(0.6e-3, 1.6e-3) * rng.normal(size=3) / np.sqrt(3)

    def sag(t, p, r):
        share = np.clip(t / 40, 0, 1)[:, None]
        now = Rotation.from_rotvec(share * turn)
        return t, now.apply(p) + share * shift, now.as_matrix() @ r

    lab.on_optical.append(sag)
    return {'rotation_deg': np.degrees(turn).tolist(), 'translation_m': shift.tolist()}


def clock_rate(lab, rng):
    """The optical clock runs at another rate."""
    rate = _sign(rng) * float(np.exp(rng.uniform(np.log(2e-4), np.log(2e-3))))
    lab.on_optical.append(lambda t, p, r: (t * (1 + rate), p, r))
    return {'rate_ppm': 1e6 * rate}


def swapped_channels(lab, rng):
    """Two connectors are exchanged."""
    one, other = sorted(int(v) for v in rng.choice(lab.tool.channel, 2, replace=False))

    def swap(lab, time, channels, flux):
        place = {int(c): i for i, c in enumerate(channels)}
        if one not in place:
            return flux
        flux = flux.copy()
        flux[:, [place[one], place[other]]] = flux[:, [place[other], place[one]]]
        return flux

    lab.on_flux.append(swap)
    return {'channels': [one, other]}


def gain_modulation(lab, rng):
    """A channel's gain swings, as by a mechanical or thermal cycle."""
    channel, rate = _tool_channel(lab, rng), rng.uniform(0.05, 0.6)
    depth, phase = rng.uniform(0.005, 0.03), rng.uniform(0, 2 * np.pi)

    def swing(lab, time, flux):
        return flux * (1 + depth * np.sin(2 * np.pi * rate * time + phase))[:, None]

    _on_channel(lab, channel, swing)
    return {'channel': channel, 'depth': depth, 'rate_hz': rate}


def low_pass(lab, rng):
    """One channel lags behind, as through a filter of first order."""
    channel, tau = _tool_channel(lab, rng), rng.uniform(0.02, 0.1)

    def lag(lab, time, flux):
        out = flux.copy()
        for i in range(1, len(flux)):
            step = time[i] - time[i - 1]
            keep, slope = np.exp(-step / tau), (flux[i] - flux[i - 1]) / step
            # Exact answer to a straight line from one sample to the next.
            out[i] = flux[i] - slope * tau + (out[i - 1] - flux[i - 1] + slope * tau) * keep
        return out

    _on_channel(lab, channel, lag)
    return {'channel': channel, 'tau_s': tau}


ACCEPTED = {
    'coil_step': {'coil_fluctuation', 'coil_step'},
    'loose_contact': {'sensor_gain_drift', 'loose_contact', 'outliers'},
    'iq_imbalance': {'sensor_gain', 'iq_imbalance'},
    'optical_scale': {'optical_scale'},
    'registration_drift': {'registration_drift'},
    'clock_rate': {'clock_rate'},
    'swapped_channels': {'swapped_channels', 'channel_swap'},
    'gain_modulation': {'sensor_gain_drift', 'gain_modulation'},
    'low_pass': {'low_pass', 'channel_delay', 'channel_lag'},
    'cluster_axis': {'sensor_axis'},
    'channel_noise': {'excess_noise'},
    'two_metals': {'static_metal', 'moving_metal'},
}
"""Names under which an effect may be found beside its own."""
