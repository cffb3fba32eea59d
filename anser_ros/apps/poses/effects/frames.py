"""Frames, clocks and filter: how the poses of a tracker and of its reference belong together.

The two unknown frames are always fitted, and some effects are found before any search.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses import effect
from anser_ros.apps.poses.effects.episodes import LooseMount
from anser_ros.apps.poses.sequence import OpticalPath, filtered
from anser_ros.arrays import Array
from anser_ros.effects.base import Remedy
from anser_ros.field.model import EffectRecord


class FrameConvention(effect.PoseEffect):
    """States how a stream's numbers are meant, as `anser_ros.apps.poses.convention` finds out."""

    name = 'frame_convention'
    summary = 'the poses follow another convention than the stream states'
    advice = 'They were read rightly; state it when exporting, or to import_poses.'
    role = effect.Role.READING


class SwappedSensors(effect.PoseEffect):
    """States whose poses are whose, as `anser_ros.apps.poses.start` finds out."""

    name = 'swapped_sensors'
    summary = 'two sensors are exchanged'
    advice = 'Their poses were put back; label the plugs.'
    role = effect.Role.SWAP


FREE = 1e3
"""Prior standard deviation, m and rad, of frames: nothing is known of them before."""


@dataclass(frozen=True, kw_only=True)
class FrameTerm(effect.PoseTerm):
    """Holds a frame as a start and a step from it."""

    # (3, 3), rotation that theta's turn (its last three, rad) comes on top of, from the left.
    start: Array

    @property
    def rotation(self) -> Array:
        """Return the start's rotation, turned by theta's rotation vector."""
        return np.asarray(Rotation.from_rotvec(self.theta[3:]).as_matrix() @ self.start)

    @property
    def translation(self) -> Array:
        """Return the translation of the frame, m."""
        return self.theta[:3]

    def turn_from(self, other: 'FrameTerm') -> Array:
        """Return the turn from another frame to this one as a rotation vector, degrees."""
        turn = Rotation.from_matrix(self.rotation @ other.rotation.T)
        return np.asarray(turn.as_rotvec(degrees=True))


class _Frame(effect.PoseEffect):
    """Theta is a translation (m) and a turn (rad)."""

    typical = FREE  # nothing is known of the frame before

    def at_frame(self, site: effect.PoseSite, place: Array, turn: Array) -> effect.PoseTerm:
        """Return the frame with a turn of zero from a rotation matrix."""
        return FrameTerm(self, site, np.array([*place, 0, 0, 0]), start=turn)

    def bounded(self, term: effect.PoseTerm) -> effect.PoseTerm:
        frame = _frame(term)
        return replace(frame, theta=np.array([*frame.translation, 0, 0, 0]), start=frame.rotation)


class OpticalFrame(_Frame):
    """Theta is the translation (m) and a turn (rad) from the optical frame to the tracker's."""

    name = 'registration'
    summary = "the optical frame is not aligned with the tracker's"
    role = effect.Role.REGISTRATION

    def framed(self, term: effect.PoseTerm, sensor: str, frames: effect.Frames) -> effect.Frames:
        frame = _frame(term)
        return replace(frames, rotation=frame.rotation, translation=frame.translation)

    def moved(
        self, before: effect.PoseTerm, after: effect.PoseTerm, middle: Array
    ) -> EffectRecord:
        """Record the turn, and the shift where the poses are, not at a camera's far origin."""
        first, last = _frame(before), _frame(after)
        shift = last.rotation @ middle + last.translation
        shift -= first.rotation @ middle + first.translation
        values = {
            'rotation_deg': last.turn_from(first).tolist(), 'translation_m': shift.tolist(),
        }  # fmt: skip
        summary = 'tracker and reference have moved against each other since the watch began'
        return EffectRecord(self.name, values, {}, {'summary': summary})

    def slopes(self, term: effect.PoseTerm, view: effect.PoseView) -> Array | None:
        """Return the derivative by a shift of all poses and a turn about the tracker's origin."""
        out = np.zeros((view.time.size, 6, 6))
        out[:, :3, :3] = np.eye(3)
        out[:, :3, 3:] = np.cross((view.position - _frame(term).translation)[:, None], np.eye(3))
        out[:, 3:, 3:] = np.eye(3)
        return out


class Mount(_Frame):
    """Theta is the sensor's place on the body (m) and a turn (rad) of its mount."""

    name = 'hand_eye'
    summary = 'the two unknown frames; no effect, always fitted'
    role = effect.Role.MOUNT

    def framed(self, term: effect.PoseTerm, sensor: str, frames: effect.Frames) -> effect.Frames:
        if not term.acts_on(sensor):
            return frames
        frame = _frame(term)
        return replace(frames, mount=frame.rotation, lever=frame.translation)

    def moved(
        self, before: effect.PoseTerm, after: effect.PoseTerm, middle: Array
    ) -> EffectRecord:
        """Record how far the sensor has moved on the body, as a mount that is loose."""
        first, last = _frame(before), _frame(after)
        values = {
            'sensor': before.site['sensor'],
            'rms_m': float(np.linalg.norm(last.translation - first.translation)),
            'rms_deg': float(np.linalg.norm(last.turn_from(first))),
        }
        summary = 'the sensor sits elsewhere on the body than when the watch began'
        return EffectRecord(LooseMount.name, values, {}, {'summary': summary})

    def slopes(self, term: effect.PoseTerm, view: effect.PoseView) -> Array | None:
        """Return the derivative of this sensor's poses by shift and turn in the body's frame."""
        if not term.acts_on(view.sensor):
            return None
        body = view.frame @ view.turn
        out = np.zeros((view.time.size, 6, 6))
        out[:, :3, :3] = body
        out[:, 3:, 3:] = body
        return out


def _frame(term: effect.PoseTerm) -> FrameTerm:
    assert isinstance(term, FrameTerm)
    return term


class PoseTimeOffset(effect.NumberEffect):
    """Applies the optical pose stamped t - theta at stamp t of a tracked pose, s."""

    name = 'time_offset'
    summary = 'the tracked stamps are late (positive) or early by the optical clock'
    advice = 'Correct the stamps by it; both streams stamped by one clock do not have it.'
    units = {'offset_s': 's'}
    plausible = {'offset_s': (-3600.0, 3600.0)}  # a clock may be off by an hour of the day
    remedy = Remedy.OPTICAL
    role = effect.Role.OFFSET
    key = 'offset_s'
    typical = 0.3  # s: offsets are some tenths of a second

    def sites(self, setting: effect.PoseSetting) -> Sequence[effect.PoseTerm]:
        own = [effect.PoseTerm(self, {'sensor': s}, np.zeros(1)) for s in setting.sensors]
        return [effect.PoseTerm(self, {}, np.zeros(1)), *(own if len(own) > 1 else [])]

    def slopes(self, term: effect.PoseTerm, view: effect.PoseView) -> Array | None:
        """Return minus the velocity of the predicted pose, or None for other sensors."""
        return -view.velocity[:, :, None] if term.acts_on(view.sensor) else None

    def clock(self, term: effect.PoseTerm, sensor: str, time: Array) -> Array:
        return time - term.theta[0] if term.acts_on(sensor) else time


class PoseClockRate(effect.NumberEffect):
    """Theta is the rate, 1e-3, by which the tracked clock gains on the optical one."""

    name = 'clock_rate'
    summary = 'the clocks of tracker and reference run apart'
    advice = (
        'Stamp both streams by one clock; the corrector removes it within this recording alone.'
    )
    units = {'rate_ppm': '1e-6'}
    plausible = {'rate_ppm': (-3e3, 3e3)}
    remedy = Remedy.OPTICAL
    role = effect.Role.RATE
    key, factor = 'rate_ppm', 1e3
    typical = 2.0  # rates err by some parts in a thousand

    def sites(self, setting: effect.PoseSetting) -> Sequence[effect.PoseTerm]:
        middle = setting.start + 0.5 * setting.duration
        return [effect.PoseTerm(self, {'middle_s': middle}, np.zeros(1))]

    def slopes(self, term: effect.PoseTerm, view: effect.PoseView) -> Array | None:
        """Return minus the velocity, the more the farther from the session's middle."""
        apart = 1e-3 * (view.time - term.site['middle_s']) / (1 + 1e-3 * term.theta[0]) ** 2
        return np.asarray(-(view.velocity * apart[:, None])[:, :, None])

    def clock(self, term: effect.PoseTerm, sensor: str, time: Array) -> Array:
        """Return the stamps, s, without what their clock gains: a rate of r makes times 1 + r."""
        middle = term.site['middle_s']
        return np.asarray(middle + (time - middle) / (1 + 1e-3 * term.theta[0]))


class PoseOpticalScale(effect.NumberEffect):
    """Theta is the scale of the optical positions less one, in 1e-3."""

    name = 'optical_scale'
    summary = "the optical tracker's millimetre is too long or too short for the tracker's"
    advice = 'Measure a known length with both: it shows which of them is wrong.'
    units = {'scale': '1'}
    plausible = {'scale': (0.9, 1.1)}
    remedy = Remedy.OPTICAL
    blocks_in_space = True
    role = effect.Role.SCALE
    key, base, factor = 'scale', 1.0, 1e-3
    typical = 30.0  # scales are off by some percent

    def sites(self, setting: effect.PoseSetting) -> Sequence[effect.PoseTerm]:
        return [effect.PoseTerm(self, {}, np.zeros(1))]

    def is_scale(self, term: effect.PoseTerm) -> bool:
        return True

    def slopes(self, term: effect.PoseTerm, view: effect.PoseView) -> Array | None:
        """Shrink positions towards the optical origin; the registration takes the rest."""
        out = np.zeros((view.time.size, 6, 1))
        out[:, :3, 0] = -1e-3 * view.optical @ view.frame.T / (1 + 1e-3 * term.theta[0])
        return out

    def seen(self, term: effect.PoseTerm, position: Array) -> Array:
        return position / (1 + 1e-3 * float(term.theta[0]))


TAUS_S = (0.015, 0.03, 0.06, 0.12, 0.24)
"""Time constants that are tried, s: below a hundredth no hand's motion distinguishes a filter from
a delay, beyond a quarter nobody would work with the tracker."""


class TrackerLag(effect.NumberEffect):
    """Theta is the time constant, s, of a first-order low pass, without slopes of its own: it is
    tried at several, beside a free time offset, as to first order it is a delay.
    """

    name = 'tracker_lag'
    summary = 'the tracker filters its poses, which rounds off quick motions'
    advice = 'Switch the filter of the tracker off, or move slowly.'
    units = {'tau_s': 's'}
    plausible = {'tau_s': (0.0, 1.0)}
    remedy = Remedy.NONE
    role = effect.Role.FILTER
    key = 'tau_s'
    typical = 0.1  # s: lags are some tenths of a second

    def sites(self, setting: effect.PoseSetting) -> Sequence[effect.PoseTerm]:
        return [effect.PoseTerm(self, {}, np.array([tau])) for tau in TAUS_S]

    def filter(self, term: effect.PoseTerm, path: OpticalPath) -> OpticalPath:
        return filtered(path, float(term.theta[0]), 'two_sided' in term.site)

    def rival(self, term: effect.PoseTerm) -> effect.PoseTerm:
        """Return the same smoothing without a sense of time."""
        return effect.PoseTerm(self, {'two_sided': True}, term.theta)


EFFECTS = (
    FrameConvention(),
    SwappedSensors(),
    OpticalFrame(),
    Mount(),
    PoseTimeOffset(),
    PoseClockRate(),
    PoseOpticalScale(),
    TrackerLag(),
)
