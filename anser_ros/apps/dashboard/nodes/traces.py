"""Traces what came in for every sensor and body, and how far it is from the optical truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from anser_ros.arrays import Array
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.stamps import LIVE_WITHIN_S
from anser_ros.wire.setup import Setup

OVERLAP = 5
"""Poses of the last row that the next one's error is of, too."""
LONGEST_OPTICAL_GAP_S = 0.1
"""Gap between optical poses, s, over which none is interpolated to compare with."""


def latency_of(now_s: float, stamp_s: float) -> float:
    """Return how old a pose is as it comes, s; NaN where its stamp is not of now."""
    age_s = now_s - stamp_s
    return age_s if abs(age_s) < LIVE_WITHIN_S else float('nan')


def middle(values: Sequence[float] | Array, of: Callable[[Array], Any] = np.median) -> float:
    """Return the median of what is finite, or another figure of it; NaN where nothing is."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    return float(of(known)) if known.size else float('nan')


@dataclass(frozen=True)
class Target:
    """Names a sensor or a body that is tracked, with its place in the body's frame."""

    name: str
    body: str
    position_m: tuple[float, float, float]


def targets_of(setup: Setup) -> list[Target]:
    """Return all tool sensors of a setup, and the bodies that carry more than one."""
    sensors = [Target(s.name, s.body, s.position_m) for s in setup.tool_sensors]
    carried = [sensor.body for sensor in sensors]
    solid = [body for body in setup.bodies if carried.count(body) > 1]
    return sensors + [Target(body, body, (0.0, 0.0, 0.0)) for body in solid]


@dataclass
class OpticalTrace:
    """Keeps poses of one body by an optical tracker, or the simulator's truth."""

    stamp_s: list[float] = field(default_factory=list)
    position: list[tuple[float, ...]] = field(default_factory=list)
    quaternion: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, stamp_s: float, position: tuple[float, ...], turn: tuple[float, ...]) -> None:
        """Note a pose; one that is not later than the last is left out."""
        if not self.stamp_s or stamp_s > self.stamp_s[-1]:
            self.stamp_s.append(stamp_s)
            self.position.append(position)
            self.quaternion.append(turn)

    def forget(self, but: int) -> None:
        """Keep only the last ``but`` poses."""
        for values in (self.stamp_s, self.position, self.quaternion):
            del values[:-but]

    def track(self, newest: int = 0) -> PoseTrack | None:
        """Return so many of the newest poses (0: all), None when there are less than two."""
        if len(self.stamp_s) < 2:
            return None
        kept = self.stamp_s, self.position, self.quaternion
        return PoseTrack(*(np.array(values[-newest:]) for values in kept))


@dataclass(frozen=True)
class Row:
    """Holds the newest of one target, for a table: its place, and medians over the interval of
    sigma, error and latency; NaN without a pose in it.
    """

    name: str
    position_m: tuple[float, ...]
    sigma_m: float
    error_m: float
    rate_hz: float
    latency_s: float


@dataclass
class PoseTrace:
    """Keeps poses of one target by one tracker; latencies are from the middle of the window."""

    target: Target
    stamp_s: list[float] = field(default_factory=list)
    position: list[tuple[float, ...]] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    forgotten: int = 0
    _shown: int = 0

    def forget(self) -> None:
        """Keep only the poses that the next row needs."""
        gone = max(len(self.stamp_s) - OVERLAP, 0)
        for values in (self.stamp_s, self.position, self.sigma_m, self.latency_s):
            del values[:gone]
        self.forgotten += gone
        self._shown -= gone

    def distances(self, optical: PoseTrack, since: int = 0) -> Array:
        """Return distances (m) to the truth of the poses from number `since` on, NaN where the
        optical track does not reach.
        """
        stamps = np.array(self.stamp_s[since:])
        if not stamps.size:
            return np.zeros(0)
        position, rotation, _ = optical.at(stamps, LONGEST_OPTICAL_GAP_S)
        true_position = position + rotation @ np.array(self.target.position_m)
        away = np.linalg.norm(np.array(self.position[since:]) - true_position, axis=1)
        return np.asarray(away)

    def row(self, optical: PoseTrack | None, elapsed_s: float) -> Row:
        since, self._shown = self._shown, len(self.stamp_s)
        count = self._shown - since
        error = float('nan')
        if count and optical is not None:
            # the last poses may be newer than the last optical one
            error = middle(self.distances(optical, max(0, since - OVERLAP)))
        position = self.position[-1] if count else (float('nan'),) * 3
        sigma, latency = middle(self.sigma_m[since:]), middle(self.latency_s[since:])
        return Row(self.target.name, position, sigma, error, count / elapsed_s, latency)
