"""The two unknown frames, which are always fitted, and what is found before any search."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.effect import Frames, PoseEffect, PoseSite, PoseTerm, PoseView, Role
from anser_ros.apps.poses.effects.episodes import LooseMount
from anser_ros.field.model import EffectRecord


class FrameConvention(PoseEffect):
    """States how a stream's numbers are meant, as `anser_ros.apps.poses.convention` finds out."""

    name = 'frame_convention'
    summary = 'the poses follow another convention than the stream states'
    role = Role.READING


class SwappedSensors(PoseEffect):
    """States whose poses are whose, as `anser_ros.apps.poses.start` finds out."""

    name = 'swapped_sensors'
    summary = 'two sensors are exchanged'
    role = Role.SWAP


Array = NDArray[np.float64]

FREE = 1e3
"""Prior standard deviation, m and rad, of frames: nothing is known of them before."""


@dataclass(frozen=True, kw_only=True)
class FrameTerm(PoseTerm):
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


class _Frame(PoseEffect):
    """Theta is a translation (m) and a turn (rad)."""

    def at_frame(self, site: PoseSite, place: Array, turn: Array) -> PoseTerm:
        """Return the frame with a turn of zero from a rotation matrix."""
        return FrameTerm(self, site, np.array([*place, 0, 0, 0]), start=turn)

    def prior(self, term: PoseTerm) -> Array:
        """Return a wide prior, as nothing is known of the frame before."""
        return np.full(6, FREE)

    def bounded(self, term: PoseTerm) -> PoseTerm:
        frame = _frame(term)
        return replace(frame, theta=np.array([*frame.translation, 0, 0, 0]), start=frame.rotation)


class OpticalFrame(_Frame):
    """Theta is the translation (m) and a turn (rad) from the optical frame to the tracker's."""

    name = 'registration'
    summary = "the optical frame is not aligned with the tracker's"
    role = Role.REGISTRATION

    def framed(self, term: PoseTerm, sensor: str, frames: Frames) -> Frames:
        frame = _frame(term)
        return replace(frames, rotation=frame.rotation, translation=frame.translation)

    def moved(self, before: PoseTerm, after: PoseTerm, middle: Array) -> EffectRecord:
        """Record the turn, and the shift where the poses are.

        A turn about the far origin of a camera moves that by decimetres.
        """
        first, last = _frame(before), _frame(after)
        shift = last.rotation @ middle + last.translation
        shift -= first.rotation @ middle + first.translation
        values = {
            'rotation_deg': last.turn_from(first).tolist(), 'translation_m': shift.tolist(),
        }  # fmt: skip
        summary = 'tracker and reference have moved against each other since the watch began'
        return EffectRecord(self.name, values, {}, {'summary': summary})

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return the derivative by a shift of all poses and a turn about the tracker's origin."""
        out = np.zeros((view.time.size, 6, 6))
        out[:, :3, :3] = np.eye(3)
        out[:, :3, 3:] = -_cross(view.position - _frame(term).translation)
        out[:, 3:, 3:] = np.eye(3)
        return out


class Mount(_Frame):
    """Theta is the sensor's place on the body (m) and a turn (rad) of its mount."""

    name = 'hand_eye'
    summary = 'the two unknown frames; no effect, always fitted'
    role = Role.MOUNT

    def framed(self, term: PoseTerm, sensor: str, frames: Frames) -> Frames:
        if not term.acts_on(sensor):
            return frames
        frame = _frame(term)
        return replace(frames, mount=frame.rotation, lever=frame.translation)

    def moved(self, before: PoseTerm, after: PoseTerm, middle: Array) -> EffectRecord:
        """Record how far the sensor has moved on the body, as a mount that is loose."""
        first, last = _frame(before), _frame(after)
        values = {
            'sensor': before.site['sensor'],
            'rms_m': float(np.linalg.norm(last.translation - first.translation)),
            'rms_deg': float(np.linalg.norm(last.turn_from(first))),
        }
        summary = 'the sensor sits elsewhere on the body than when the watch began'
        return EffectRecord(LooseMount.name, values, {}, {'summary': summary})

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return the derivative of this sensor's poses by shift and turn in the body's frame."""
        if not term.acts_on(view.sensor):
            return None
        body = view.frame @ view.turn
        out = np.zeros((view.time.size, 6, 6))
        out[:, :3, :3] = body
        out[:, 3:, 3:] = body
        return out


def _cross(vectors: Array) -> Array:
    """Matrices (n, 3, 3) of the cross product with vectors (n, 3)."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out


def _frame(term: PoseTerm) -> FrameTerm:
    assert isinstance(term, FrameTerm)
    return term


EFFECTS = (
    FrameConvention(),
    SwappedSensors(),
    OpticalFrame(),
    Mount(),
)
