"""Follows poses through time: how far a sensor or body may have moved, and when a track begins.

A single residual that passes the gate proves little when most of its neighbours in time do not: a
few wrong poses pass by chance. So after withheld poses a pose needs consistent ones before it.
Points that were recorded one by one, further apart than `STREAM_GAP_S`, have no neighbours in
time, and each is judged alone.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from anser_ros.stamps import NANO

STREAM_GAP_S = 0.5
"""Frames further apart than this, s, are single points and no stream, as of a robot that stops
once a second."""
RECORD_S = 1.0
"""How far back refusals count, s; after a distortion has ended a tool waits as long."""
MOST_REFUSED = 0.5
"""Share (0 to 1) of refused frames in the record from which on a good one needs confirmation: a
pass is then more likely chance than not."""
START_FRAMES = 3
"""Fewest consecutive frames, the last one included, that confirm a pose: 60 ms at 50 Hz. Two wrong
ones may agree."""
LONGEST_RUN_S = 0.25
"""Longest run that is asked for, s; the run is as long as the refusal before it up to this: 12
frames at 50 Hz all pass by chance once in 5e5 times where a third do."""
SIGMAS = 3.0
"""Allowance for the poses' own errors, in units of `Place.sigma_m`, beside the bounds of the
motion."""


class MotionBounds(NamedTuple):
    """Holds the largest speed (m/s) and acceleration (m/s^2) of a tool."""

    speed_m_s: float
    acceleration_m_s2: float


class Place(NamedTuple):
    """States where something was, and how well that is known: stamp, position (m), its sigma,
    m."""

    stamp_ns: int
    position: Sequence[float]
    sigma_m: float


def motion_contradiction(before: list[Place], now: Place, bounds: MotionBounds) -> str:
    """State how a place contradicts the places before it, oldest first; empty if it does not.

    Of the last two places and this one: for an acceleration of at most a, the place is no further
    than ``a dt (dt + dt_before) / 2`` from where the mean velocity before leads.
    """
    if not before:
        return ''
    last = before[-1]
    dt = (now.stamp_ns - last.stamp_ns) * NANO
    away = math.dist(now.position, last.position)
    error = SIGMAS * math.hypot(now.sigma_m, last.sigma_m)
    if away > bounds.speed_m_s * dt + error:
        return f'{1e3 * away:.3g} mm in {1e3 * dt:.3g} ms is a speed of {away / dt:.3g} m/s'
    if len(before) < 2:
        return ''
    first = before[-2]
    dt_before = (last.stamp_ns - first.stamp_ns) * NANO
    steps = dt / dt_before
    led = [b + steps * (b - a) for a, b in zip(first.position, last.position, strict=True)]
    bent = math.dist(now.position, led)
    error = SIGMAS * math.hypot(now.sigma_m, (1.0 + steps) * last.sigma_m, steps * first.sigma_m)
    time = 0.5 * dt * (dt + dt_before)
    if bent > bounds.acceleration_m_s2 * time + error:
        return f'an acceleration of {bent / time:.3g} m/s^2'
    return ''


class Continuity:
    """Judges one sensor's or body's poses through time."""

    def __init__(self) -> None:
        self._track: list[Place] = []
        self._run: list[Place] = []
        self._frames = 0
        self._began_ns = 0
        self._last_ns = 0
        self._record: deque[tuple[int, bool]] = deque()
        self._refused = 0

    @property
    def refused_share(self) -> float:
        """Return the share of the last second's frames that were refused in spite of signals."""
        return self._refused / max(len(self._record), 1)

    def forget(self) -> None:
        """Forget all frames that were judged so far."""
        self._track, self._run, self._frames, self._last_ns = [], [], 0, 0
        self._record.clear()
        self._refused = 0

    def judge(
        self, stamp_ns: int, place: Place | None, refused: bool, bounds: MotionBounds
    ) -> str:
        """Judge the next frame.

        Parameters
        ----------
        stamp_ns : int
            Of the frame.
        place : Place or None
            Of the pose, where it is good by itself.
        refused : bool
            Whether there is no pose although there are signals.
        bounds : MotionBounds

        Returns
        -------
        str
            Why the pose is not confirmed; empty where it is, and where there is no pose.
        """
        last_ns = self._last_ns
        alone = not last_ns or not 0 < stamp_ns - last_ns <= STREAM_GAP_S / NANO
        if alone:
            self.forget()
        self._last_ns = stamp_ns
        self._note(stamp_ns, place is None and refused, place is not None or refused)
        if place is None:
            self._run, self._frames = [], 0
            return ''
        contradiction = motion_contradiction(self._track, place, bounds)
        old = not self._track or stamp_ns - self._track[-1].stamp_ns > RECORD_S / NANO
        if not (old or contradiction or self._refused > MOST_REFUSED * len(self._record)):
            self._track, self._frames = [self._track[-1], place], 0
            return ''
        if not self._frames or motion_contradiction(self._run, place, bounds):
            self._run, self._frames, self._began_ns = [], 0, stamp_ns
        self._run, self._frames = [*self._run[-1:], place], self._frames + 1
        if alone or self._is_confirmed(stamp_ns):
            self._track = list(self._run)
            return ''
        if contradiction and not old:
            return contradiction
        return (
            f'{100 * self.refused_share:.0f} % of the frames of the last second were refused, '
            f'and {self._frames} good frames in a row are too few'
        )

    def _is_confirmed(self, stamp_ns: int) -> bool:
        """Whether the run is long enough: as long as refusals were lately, up to a bound."""
        needed_s = min(self.refused_share * RECORD_S, LONGEST_RUN_S)
        return self._frames >= START_FRAMES and (stamp_ns - self._began_ns) * NANO >= needed_s

    def _note(self, stamp_ns: int, refused: bool, counts: bool) -> None:
        record = self._record
        while record and stamp_ns - record[0][0] > RECORD_S / NANO:
            self._refused -= record.popleft()[1]
        if counts:
            record.append((stamp_ns, refused))
            self._refused += refused
