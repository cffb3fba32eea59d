"""Finds the pose of a tool's tip: its body's, carried along the lever arm with its uncertainty."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.tracking.estimate import PoseEstimate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Tip:
    """States where a tip is on its body."""

    name: str  # Of the tip, in topics and in ``/diagnostics``
    position: Array  # (3,), m, body's frame
    covariance: Array  # (3, 3), m^2, body's frame: what its calibration leaves unknown

    def of_body(self, body: PoseEstimate) -> PoseEstimate:
        """Return the tip's pose with its body's state; none where the body has none.

        The tip moves with the body's position and by a turn times the arm. To first order, with
        the arm ``a`` in fg, ``d_tip = d_body - [a]x d_turn + R d_arm``, and turns are the body's.
        """
        if body.rotation is None:
            nothing = np.full(3, np.nan)
            return replace(
                body, name=self.name, position=nothing, axis=nothing,
                covariance=np.full((6, 6), np.nan), sigma_position_m=math.nan,
            )  # fmt: skip
        arm = body.rotation @ self.position
        x, y, z = arm
        carry = np.eye(6)
        carry[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        covariance = carry @ body.covariance @ carry.T
        covariance[:3, :3] += body.rotation @ self.covariance @ body.rotation.T
        return replace(
            body,
            name=self.name,
            position=body.position + arm,
            covariance=covariance,
            sigma_position_m=math.sqrt(float(np.trace(covariance[:3, :3]))),
        )
