"""Fits the two unknown frames, which are always there and no effect.

One term holds the registration (optical frame to the tracker's), one a sensor its place and its
mount on the body. Both are kept as a start and small turns about it.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.effects.term import Site, Term
from anser_ros.poses.effect import PoseEffect, PoseView

Array = NDArray[np.float64]

FREE = 1e3
"""Prior standard deviation, m and rad, of frames: nothing is known of them before."""


@dataclass(frozen=True, kw_only=True)
class FrameTerm(Term):
    """Holds a frame as a start and a step from it.

    Attributes
    ----------
    start : ndarray, shape (3, 3)
        Rotation that theta's turn (its last three, rad) comes on top of, from the left.
    """

    start: Array

    @property
    def rotation(self) -> Array:
        """Return the start's rotation, turned by theta's rotation vector."""
        return np.asarray(Rotation.from_rotvec(self.theta[3:]).as_matrix() @ self.start)

    @property
    def translation(self) -> Array:
        """Return the translation of the frame, m."""
        return self.theta[:3]

    def rebased(self) -> Self:
        """Return the same frame with a turn of zero."""
        return type(self)(
            self.effect, self.site, np.array([*self.theta[:3], 0, 0, 0]), self.held,
            start=self.rotation,
        )  # fmt: skip


class OpticalFrame(PoseEffect):
    """Theta is the translation (m) and a turn (rad) from the optical frame to the tracker's."""

    name = 'registration'
    summary = "the optical frame is not aligned with the tracker's"

    def prior(self, term: Term) -> Array:
        """Return a wide prior, as nothing is known of the frame before."""
        return np.full(6, FREE)

    def slopes(self, term: Term, view: PoseView) -> Array | None:
        """Return the derivative by a shift of all poses and a turn about the tracker's origin."""
        assert isinstance(term, FrameTerm)
        out = np.zeros((view.time.size, 6, 6))
        out[:, :3, :3] = np.eye(3)
        out[:, :3, 3:] = -_cross(view.position - term.translation)
        out[:, 3:, 3:] = np.eye(3)
        return out


class Mount(PoseEffect):
    """Theta is the sensor's place on the body (m) and a turn (rad) of its mount."""

    name = 'mount'
    summary = 'where and how the sensor sits on the body'

    def prior(self, term: Term) -> Array:
        """Return a wide prior, as nothing is known of the mount before."""
        return np.full(6, FREE)

    def slopes(self, term: Term, view: PoseView) -> Array | None:
        """Return the derivative of this sensor's poses by shift and turn in the body's frame."""
        if not self.acts_on(term, view.sensor):
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


def frame_term(effect: Any, site: Site, place: Array, turn: Array) -> FrameTerm:
    """Return the term of a frame at a place (m) with a rotation matrix."""
    return FrameTerm(effect, site, np.array([*place, 0, 0, 0]), start=turn)


EFFECTS = (OpticalFrame(), Mount())
