"""Sessions of poses with known truth, made without any of the package's own models."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.sequence import PoseSession, sequence_of

FRAME = Rotation.from_euler('xyz', [100, -35, 70], degrees=True)
SHIFT = np.array([0.25, -0.4, 0.9])


class World:
    """A hand's smooth motion, a tracker that sees it and an optical one that sees it too."""

    def __init__(self, seed, duration=30.0, sensors=2, rate=20.0, optical_rate=20.0):
        self.rng = np.random.default_rng(seed)
        self.duration, self.rate, self.optical_rate = duration, rate, optical_rate
        knots = np.arange(-2.0, duration + 3.0, 0.7)
        self._place = CubicSpline(knots, self.rng.normal(0, 0.06, (knots.size, 3)))
        self._turn = CubicSpline(knots, self.rng.normal(0, 0.25, (knots.size, 3)))
        self.levers = self.rng.normal(0, 0.04, (sensors, 3))
        self.mounts = Rotation.random(sensors, random_state=self.rng.integers(2**31))
        self.noise_m, self.noise_rad = 3e-4, 3e-3
        # What may be changed before `session`.
        self.offset, self.rate_ppm, self.jitter, self.tau, self.scale = 0.0, 0.0, 0.0, 0.0, 1.0
        self.bend = lambda sensor, place: place
        self.spread = lambda sensor, place: np.ones(len(place))
        self.shift = lambda sensor, time: np.zeros((time.size, 3))
        self.after = lambda streams: streams
        self.when = lambda time: time  # of the reference's poses

    def follow(self, place, turn):
        """Move another way: places (m, about the middle) and turns (rad) as functions of time."""
        self._place, self._turn = place, turn

    def body(self, time):
        """Place and turn of the body in the tracker's frame, behind the low pass."""
        if self.tau == 0.0:
            place, turn = self._place(time), self._turn(time)
        else:
            # A straight line between ages goes through the filter exactly: the mean age is tau.
            step, steps = 0.05, np.arange(321)
            weight = np.exp(-step * steps) * 2 * (np.cosh(step) - 1) / step
            weight[0] = 1 - (1 - np.exp(-step)) / step
            weight /= weight.sum()
            ages = step * steps * self.tau
            place = sum(w * self._place(time - a) for w, a in zip(weight, ages, strict=True))
            turn = sum(w * self._turn(time - a) for w, a in zip(weight, ages, strict=True))
        return place + [0.05, 0.02, -0.3], Rotation.from_rotvec(turn)

    def sensor(self, number, time):
        place, turn = self.body(time)
        lever = self.levers[number] + self.shift(number, time)
        return place + turn.apply(lever), turn * self.mounts[number]

    def session(self):
        rng, streams = self.rng, {}
        for number in range(len(self.levers)):
            true = np.arange(0.013 * number, self.duration, 1 / self.rate)
            place, turn = self.sensor(number, true)
            noise = self.noise_m * self.spread(number, place)
            place = self.bend(number, place) + noise[:, None] * rng.normal(size=place.shape)
            turn = Rotation.from_rotvec(self.noise_rad * rng.normal(size=place.shape)) * turn
            stamp = true + self.offset + 1e-6 * self.rate_ppm * (true - self.duration / 2)
            stamp = stamp + self.jitter * rng.normal(size=true.size)
            streams[f'sensor_{number}'] = [stamp, place, turn.as_quat()]
        tau, self.tau = self.tau, 0.0
        time = self.when(np.arange(-0.5, self.duration + 0.5, 1 / self.optical_rate))
        place, turn = self.body(time)
        self.tau = tau
        place = self.scale * FRAME.inv().apply(place - SHIFT)
        place += 1e-4 * rng.normal(size=place.shape)
        turn = Rotation.from_rotvec(1e-3 * rng.normal(size=place.shape)) * (FRAME.inv() * turn)
        streams['optical'] = [time, place, turn.as_quat()]
        streams = self.after(streams)
        made = {
            name: sequence_of(name, rows[0] + 1.0, *rows[1:]) for name, rows in streams.items()
        }
        reference = made.pop('optical', None)
        return PoseSession('simulated', 10**9, made, reference)


def write_tum(path, poses, start=100.0, scale=1.0):
    """Write poses as a file in TUM's form, their stamps from a time (s) on."""
    rows = np.c_[poses.time + start, scale * poses.position, poses.quaternion]
    np.savetxt(path, rows, fmt='%.9f')
    return str(path)


def named(found):
    """The effects that a diagnosis names, by name; frames are no error."""
    return {record.name: record for record in found.records if record.name != 'hand_eye'}
