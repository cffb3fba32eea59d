"""Tracks the last frame once more just before the next one comes, for the sake of the caches.

In the 15 ms between two frames other programs fill the processor's caches: a frame that takes
0.5 ms one after the other takes 1.4 ms after such a pause, and 0.9 ms after a rehearsal.
"""

from anser_ros.errors import AnserError
from anser_ros.physics.sensor import SensorTable
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.tracker import Tracker
from anser_ros.wire.points import FluxPoints

LONGEST_S = 0.006
"""A frame that took longer, s, is not rehearsed: 3 ms are usual, and there are 4. Shorter, and a
busy machine does without when it needs it most; longer, and a rehearsal is not over when the next
frame comes."""


class Rehearsal:
    """Has a tracker of its own, whose poses nobody gets."""

    def __init__(self, sensors: SensorTable, settings: TrackerSettings) -> None:
        self._past = Tracker(None, sensors, settings)
        self._frame: tuple[int, FluxPoints] | None = None

    def note(self, stamp_ns: int, points: FluxPoints, took_s: float, *, has_poses: bool) -> None:
        """Take in a frame that was tracked, how long that took, and whether poses were allowed."""
        self._frame = (stamp_ns, points) if has_poses and took_s < LONGEST_S else None

    def play(self, tracker: Tracker) -> None:
        """Track the last frame as a tracker did; nothing of it is left in that one."""
        if self._frame is None:
            return
        stamp_ns, points = self._frame
        try:
            tracker.with_past_of(self._past).update(
                stamp_ns, points.channel, points.flux, points.flags
            )
        except AnserError:  # the frame itself was refused with these words
            return
