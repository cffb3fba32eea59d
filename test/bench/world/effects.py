"""What can go wrong with the instruments of a laboratory, each of a random size."""

import numpy as np
from scipy.spatial.transform import Rotation


def _sign(rng):
    return float(rng.choice([-1.0, 1.0]))


def _direction(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def sensor_gain(lab, rng):
    """One channel's complex gain."""
    channel = int(rng.choice(lab.tool.channel))
    gain, phase = 1 + _sign(rng) * rng.uniform(0.01, 0.04), rng.uniform(-1.0, 1.0)
    factor = gain * np.exp(1j * np.radians(phase))
    lab.on_flux.append(
        lambda lab, time, channels, flux: (
            flux * np.where(np.asarray(channels) == channel, factor, 1.0)[:, None]
        )
    )


def registration(lab, rng):
    """The optical frame is not the board's: optical = R fg + t."""
    turn = rng.uniform(0.15, 0.7) * _direction(rng)
    shift = rng.uniform(0.5e-3, 1.8e-3) * _direction(rng)
    matrix = Rotation.from_rotvec(np.radians(turn)).as_matrix()
    lab.on_optical.append(lambda t, p, r: (t, p @ matrix.T + shift, matrix @ r))


def coil_drift(lab, rng):
    """An emitter warms up."""
    coil, amount = int(rng.integers(lab.board.omega.size)), _sign(rng) * rng.uniform(0.01, 0.04)
    tau = float(np.exp(rng.uniform(np.log(6), np.log(40))))

    def change(lab, time, channels, flux):
        flux = flux.copy()
        warm = 1 - np.exp(-np.maximum(np.asarray(time), 0) / tau)
        flux[..., coil] *= (1 + amount * warm)[:, None]
        return flux

    lab.on_flux.insert(0, change)
