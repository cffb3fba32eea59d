"""Where the tool and the metal are at every time."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Wander:
    """Smooth motion through the volume with changing orientation: sums of slow sines.

    Drawn once from ``rng``; then a function of time only.
    """

    low: np.ndarray
    high: np.ndarray
    rates: np.ndarray
    phases: np.ndarray
    weights: np.ndarray
    tilt_rad: float

    @classmethod
    def drawn(cls, rng, low, high, fastest_hz=0.22, tilt_rad=0.75):
        """A motion between two corners (m)."""
        rates = rng.uniform(0.04, fastest_hz, (6, 3)) * 2 * np.pi
        weights = rng.uniform(0.5, 1.0, (6, 3))
        return cls(
            np.asarray(low), np.asarray(high), rates, rng.uniform(0, 2 * np.pi, (6, 3)),
            weights / weights.sum(axis=1)[:, None], tilt_rad,
        )  # fmt: skip

    def at(self, time):
        """Position (F, 3) m and rotation (F, 3, 3)."""
        waves = np.sin(np.asarray(time)[:, None, None] * self.rates + self.phases)
        waves = np.clip(1.35 * np.sum(waves * self.weights, axis=-1), -1, 1)
        waves = np.sin(0.5 * np.pi * waves)
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        tilt = self.tilt_rad * waves[:, 3:] * [1.0, 1.0, 0.6]
        return middle + half * waves[:, :3], Rotation.from_rotvec(tilt).as_matrix()


@dataclass(frozen=True)
class Travel:
    """A body that goes from one pose to another between two times, gently at both ends."""

    start: np.ndarray
    end: np.ndarray
    t_start: float
    t_end: float
    turn_start: np.ndarray
    turn_end: np.ndarray
    bow: np.ndarray

    @property
    def moves(self):
        """Whether it moves at all."""
        return self.t_end > self.t_start

    def at(self, time):
        """Position (F, 3) m and rotation (F, 3, 3)."""
        time = np.asarray(time, dtype=np.float64)
        if not self.moves:
            turn = Rotation.from_rotvec(self.turn_start).as_matrix()
            return np.tile(self.start, (time.size, 1)), np.tile(turn, (time.size, 1, 1))
        s = np.clip((time - self.t_start) / (self.t_end - self.t_start), 0, 1)[:, None]
        s = s * s * (3 - 2 * s)
        place = self.start + s * (self.end - self.start) + 4 * s * (1 - s) * self.bow
        turn = self.turn_start + s * (self.turn_end - self.turn_start)
        return place, Rotation.from_rotvec(turn).as_matrix()


def resting(place, turn):
    """A body that stands."""
    place, turn = np.asarray(place, dtype=np.float64), np.asarray(turn, dtype=np.float64)
    return Travel(place, place, 0.0, 0.0, turn, turn, np.zeros(3))


def raster(scan, rng):
    """Poses of a static scan: places near a grid's points and small tilts, column by column."""
    line = np.linspace(-scan['half_m'], scan['half_m'], scan['count'])
    place = np.array([(x, y, z) for z in scan['heights_m'] for x in line for y in line])
    place = place + rng.uniform(-0.0045, 0.0045, place.shape)
    turn = Rotation.from_rotvec(scan['tilt_rad'] * rng.normal(size=place.shape))
    return place, turn.as_matrix()
