"""Moves simulated bodies on paths: a tool on a smooth one, metal that approaches and leaves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Pose = tuple[Array, Array]
"""A position (3,), m, and a rotation matrix (3, 3) from the body's frame to fg."""

Path = Callable[[float], Pose]
"""A function from a time in seconds to a pose."""


@dataclass(frozen=True)
class Lissajous:
    """Describes a path of a sine in each coordinate and each component of the rotation vector."""

    # centre_m, amplitude_m, period_s: centre (m), amplitude (m) and period (s) of x, y and z in fg
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.15)
    amplitude_m: tuple[float, float, float] = (0.08, 0.08, 0.03)
    period_s: tuple[float, float, float] = (9.0, 12.5, 7.0)
    # turn_rad, turn_period_s: amplitude (rad) and period (s) of the components of the rotation
    # vector
    turn_rad: tuple[float, float, float] = (0.5, 0.4, 0.8)
    turn_period_s: tuple[float, float, float] = (11.0, 8.0, 17.0)
    phase_rad: float = 0.0  # phase at the start, so that two bodies need not move alike

    def __call__(self, time_s: float) -> Pose:
        """Return the pose at a time, s."""
        angle = 2 * np.pi * time_s / np.array(self.period_s) + self.phase_rad
        position = np.array(self.centre_m) + np.array(self.amplitude_m) * np.sin(angle)
        turn = 2 * np.pi * time_s / np.array(self.turn_period_s) + self.phase_rad
        rotation = Rotation.from_rotvec(np.array(self.turn_rad) * np.sin(turn))
        return position, np.asarray(rotation.as_matrix())


BODY_PHASE_RAD = 0.7
"""Phase difference between the paths of one body and the next, so that they stay apart."""


def tool_paths(bodies: Sequence[str], phase_rad: float = 0.0) -> Mapping[str, Path]:
    """Return the default path of each body, by its name."""
    return {
        body: Lissajous(phase_rad=phase_rad + BODY_PHASE_RAD * rank)
        for rank, body in enumerate(bodies)
    }


@dataclass(frozen=True)
class Approach:
    """Describes a path that comes near, stays, and leaves again, each way along a smooth ramp."""

    # far_m, near_m: positions between which it moves, m, frame fg
    far_m: tuple[float, float, float] = (0.05, -0.03, -0.6)
    near_m: tuple[float, float, float] = (0.05, -0.03, -0.08)
    # start_s, travel_s, stay_s: time of the start, time for one way, and time near, s
    start_s: float = 8.0
    travel_s: float = 5.0
    stay_s: float = 6.0
    period_s: float = 0.0  # time after which the visit repeats, s; 0 for a single visit

    def __call__(self, time_s: float) -> Pose:
        """Return the pose at a time, s; the orientation is constant."""
        local = time_s - self.start_s
        if self.period_s > 0 and local > 0:
            local %= self.period_s
        inward = local / self.travel_s
        outward = (2 * self.travel_s + self.stay_s - local) / self.travel_s
        share = float(np.clip(min(inward, outward), 0.0, 1.0))
        smooth = share * share * (3 - 2 * share)
        far, near = np.array(self.far_m), np.array(self.near_m)
        return far + smooth * (near - far), np.eye(3)
