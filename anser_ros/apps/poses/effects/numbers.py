"""Effects of one number: clocks that differ, the reference's scale, the tracker's low pass."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.apps.poses.effect import NumberEffect, PoseSetting, PoseTerm, PoseView, Role
from anser_ros.apps.poses.sequence import OpticalPath, filtered
from anser_ros.effects.base import Remedy

Array = NDArray[np.float64]


class PoseTimeOffset(NumberEffect):
    """Applies the optical pose stamped t - theta at stamp t of a tracked pose, s."""

    name = 'time_offset'
    summary = 'the tracked stamps are late (positive) or early by the optical clock'
    advice = 'Correct the stamps by it; both streams stamped by one clock do not have it.'
    units = {'offset_s': 's'}
    plausible = {'offset_s': (-5.0, 5.0)}
    remedy = Remedy.OPTICAL
    role = Role.OFFSET
    key = 'offset_s'
    spread = 0.3  # s: offsets are some tenths of a second

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        own = [PoseTerm(self, {'sensor': s}, np.zeros(1)) for s in setting.sensors]
        return [PoseTerm(self, {}, np.zeros(1)), *(own if len(own) > 1 else [])]

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return minus the velocity of the predicted pose, or None for other sensors."""
        return -view.velocity[:, :, None] if term.acts_on(view.sensor) else None

    def clock(self, term: PoseTerm, sensor: str, time: Array) -> Array:
        return time - term.theta[0] if term.acts_on(sensor) else time


class PoseClockRate(NumberEffect):
    """Theta is the rate, 1e-3, by which the tracked clock gains on the optical one."""

    name = 'clock_rate'
    summary = 'the clocks of tracker and reference run apart'
    advice = (
        'Stamp both streams by one clock; the corrector removes it within this recording alone.'
    )
    units = {'rate_ppm': '1e-6'}
    plausible = {'rate_ppm': (-3e3, 3e3)}
    remedy = Remedy.OPTICAL
    role = Role.RATE
    key, factor = 'rate_ppm', 1e3
    spread = 2.0  # rates err by some parts in a thousand

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        middle = setting.start + 0.5 * setting.duration
        return [PoseTerm(self, {'middle_s': middle}, np.zeros(1))]

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return minus the velocity, the more the farther from the session's middle."""
        apart = 1e-3 * (view.time - term.site['middle_s']) / (1 + 1e-3 * term.theta[0]) ** 2
        return np.asarray(-(view.velocity * apart[:, None])[:, :, None])

    def clock(self, term: PoseTerm, sensor: str, time: Array) -> Array:
        """Return the stamps, s, without what their clock gains: a rate of r makes times 1 + r."""
        middle = term.site['middle_s']
        return np.asarray(middle + (time - middle) / (1 + 1e-3 * term.theta[0]))


class PoseOpticalScale(NumberEffect):
    """Theta is the scale of the optical positions less one, in 1e-3."""

    name = 'optical_scale'
    summary = "the optical tracker's millimetre is too long or too short for the tracker's"
    advice = 'Measure a known length with both: it shows which of them is wrong.'
    units = {'scale': '1'}
    plausible = {'scale': (0.9, 1.1)}
    remedy = Remedy.OPTICAL
    blocks_in_space = True
    role = Role.SCALE
    key, base, factor = 'scale', 1.0, 1e-3
    spread = 30.0  # scales are off by some percent

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        return [PoseTerm(self, {}, np.zeros(1))]

    def is_scale(self, term: PoseTerm) -> bool:
        return True

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Shrink positions towards the optical origin; the registration takes the rest."""
        out = np.zeros((view.time.size, 6, 1))
        out[:, :3, 0] = -1e-3 * view.optical @ view.frame.T / (1 + 1e-3 * term.theta[0])
        return out

    def seen(self, term: PoseTerm, position: Array) -> Array:
        return position / (1 + 1e-3 * float(term.theta[0]))


TAUS_S = (0.015, 0.03, 0.06, 0.12, 0.24)
"""Time constants that are tried, s: below a hundredth no hand's motion distinguishes a filter from
a delay, beyond a quarter nobody would work with the tracker."""


class TrackerLag(NumberEffect):
    """Theta is the time constant, s, of a first-order low pass on position and rotation.

    To first order a filter is a delay, so only its smoothing distinguishes it from one: it has no
    slopes of its own, and is tried at several time constants beside a free time offset.
    """

    name = 'tracker_lag'
    summary = 'the tracker filters its poses, which rounds off quick motions'
    advice = 'Switch the filter of the tracker off, or move slowly.'
    units = {'tau_s': 's'}
    plausible = {'tau_s': (0.0, 1.0)}
    remedy = Remedy.NONE
    role = Role.FILTER
    key = 'tau_s'
    spread = 0.1  # s: lags are some tenths of a second

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        return [PoseTerm(self, {}, np.array([tau])) for tau in TAUS_S]

    def filter(self, term: PoseTerm, path: OpticalPath) -> OpticalPath:
        return filtered(path, float(term.theta[0]), 'two_sided' in term.site)

    def rival(self, term: PoseTerm) -> PoseTerm:
        """Return the same smoothing without a sense of time."""
        return PoseTerm(self, {'two_sided': True}, term.theta)


EFFECTS = (
    PoseTimeOffset(),
    PoseClockRate(),
    PoseOpticalScale(),
    TrackerLag(),
)
