"""Judges whether the field model still fits what all sensors measure.

One sensor's residual may be bad for many reasons. When nearly all sensors have bad residuals for
seconds, the model belongs to another board, is out of date, or has a wrong scale, and the few
poses that pass the gate are wrong by as much as the gate allows.
"""

import math
from collections import deque

from anser_ros.integrity.continuity import STREAM_GAP_S
from anser_ros.stamps import NANO

RECORD_S = 2.0
"""How far back readings count, s. Smaller, and metal that passes makes the model doubtful; larger,
and a wrong model gives poses for longer."""
DOUBTFUL = 0.8
"""Share of refused readings from which on the model is doubtful; by chance every third pose passes
a model that is a little wrong."""
FEWEST_JUDGED_READINGS = 6
"""Readings that a share is made of at least: a single bad coil is not the whole chain."""
GOOD_SHARE = 0.2
"""Share (0 to 1) of refused readings up to which a frame speaks for the model: one bad coil of
five."""
RECOVERY_S = 0.5
"""For so long, s, all frames must speak for a doubtful model before it gives poses again: where it
happens to fit, it is not yet right."""


class ModelRecord:
    """Counts how many readings the model explained lately."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, int, int, float]] = deque()
        self._refused = self._total = 0
        self._sound_since_ns = 0
        self._last_ns = 0
        self.is_doubtful = False

    def forget(self) -> None:
        """Forget all frames that were judged so far."""
        self.__init__()  # type: ignore[misc]

    @property
    def refused_share(self) -> float:
        """Return the share of the last seconds' readings that the model did not explain."""
        return self._refused / max(self._total, 1)

    def add(self, stamp_ns: int, refused: int, total: int, residual: float) -> None:
        """Take in a frame: how many of its readings the model did not explain.

        ``residual`` is the typical one of these in units of the expected one; NaN for none.
        """
        last_ns = self._last_ns
        if not last_ns or not 0 < stamp_ns - last_ns <= STREAM_GAP_S / NANO:
            self.forget()
        self._last_ns = stamp_ns
        frames = self._frames
        while frames and stamp_ns - frames[0][0] > RECORD_S / NANO:
            _, gone, counted, _ = frames.popleft()
            self._refused, self._total = self._refused - gone, self._total - counted
        frames.append((stamp_ns, refused, total, residual))
        self._refused, self._total = self._refused + refused, self._total + total
        if (total and refused > GOOD_SHARE * total) or not self._sound_since_ns:
            self._sound_since_ns = stamp_ns
        is_sound = stamp_ns - self._sound_since_ns >= RECOVERY_S / NANO
        if (
            self._total >= FEWEST_JUDGED_READINGS
            and self.refused_share > DOUBTFUL
            and not is_sound
        ):
            self.is_doubtful = True
        elif is_sound:
            self.is_doubtful = False

    @property
    def reason(self) -> str:
        """Return why the model is doubtful: the share, and how large residuals are."""
        residuals = sorted(r for _, _, _, r in self._frames if math.isfinite(r))
        typical = residuals[len(residuals) // 2] if residuals else math.nan
        return (
            f'{100 * self.refused_share:.0f} % of the readings of the last {RECORD_S:g} s '
            f'contradict the model, residual {typical:.3g} times the expected one'
        )
