"""Finds the baseline: the reading of each reference sensor while no metal is near.

It is the mean over the last moments before the refit starts. The live refit works on the change
of the readings since then, so that the errors of the survey cancel in it.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Frame
from anser_ros.physics.sensor import SensorTable

ComplexArray = NDArray[np.complex128]

FEWEST_BASELINE_FRAMES = 3
"""Frames that a baseline needs at least: their scatter is its noise."""
MOST_FRAMES = 2000
"""Most recent frames that a baseline is averaged over, 40 s at 50 Hz."""


class ReadingWindow:
    """Holds the most recent readings of a set of sensors.

    ``span_s``: how far back readings are kept, s of their stamps.

    Raises
    ------
    FitError
        When the span is not positive.
    """

    def __init__(self, sensors: SensorTable, emitters: int, span_s: float) -> None:
        if not span_s > 0:
            raise FitError(f'the span of a baseline must be positive, got {span_s}')
        self._shape = (len(sensors), emitters)
        self._span_ns = round(1e9 * span_s)
        self._frames: deque[tuple[int, ComplexArray]] = deque(maxlen=MOST_FRAMES)

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def full(self) -> bool:
        """Return whether the readings reach back over (nearly) the whole span."""
        if len(self._frames) < FEWEST_BASELINE_FRAMES:
            return False
        return self._frames[-1][0] - self._frames[0][0] >= 0.9 * self._span_ns

    def clear(self) -> None:
        """Forget all readings that were taken in so far."""
        self._frames.clear()

    def add(self, frame: Frame) -> None:
        """Take in a judged frame of the sensors; a jump back in time restarts it.

        Raises
        ------
        FitError
            When the number of emitters is another one.
        """
        if frame.flux.shape != self._shape:
            raise FitError(
                f'readings must be of {self._shape[1]} emitters, got {frame.flux.shape}'
            )
        stamp_ns = frame.stamp_ns
        if self._frames and stamp_ns < self._frames[-1][0]:
            self._frames.clear()
        self._frames.append((stamp_ns, frame.readings))
        while stamp_ns - self._frames[0][0] > self._span_ns:
            self._frames.popleft()

    @property
    def frames(self) -> ComplexArray:
        """Return all readings (F, S, K), T, in the order of time; NaN in place of bad ones."""
        return np.stack([frame for _, frame in self._frames])

    def mean(self) -> ComplexArray:
        """Return the mean reading (S, K), T, with NaN for sensors that are bad in half the frames.

        Raises
        ------
        FitError
            When there are too few frames, or no sensor has good readings.
        """
        if len(self._frames) < FEWEST_BASELINE_FRAMES:
            raise FitError(
                f'a baseline needs {FEWEST_BASELINE_FRAMES} frames of reference readings, '
                f'there are {len(self._frames)}'
            )
        stack = self.frames
        good = np.asarray(np.isfinite(stack).all(axis=2))
        count = np.asarray(good.sum(axis=0))
        total = np.where(good[:, :, None], stack, 0.0).sum(axis=0)
        enough = np.asarray(2 * count >= len(stack))
        if not enough.any():
            raise FitError('no reference sensor has good readings')
        mean = np.full(self._shape, np.nan, dtype=np.complex128)
        mean[enough] = total[enough] / count[enough, None]
        return mean


def check_enough(baseline: ComplexArray, needed: int) -> int:
    """Return the number of sensors that have a value in a baseline of shape (S, K).

    Raises
    ------
    FitError
        When there are fewer than are needed.
    """
    count = int(np.isfinite(baseline).all(axis=1).sum())
    if count < needed:
        raise FitError(
            f'a baseline of {count} of {len(baseline)} reference sensors; {needed} are needed'
        )
    return count


def checked_baseline(
    model: FieldModel, references: SensorTable, baseline: ComplexArray
) -> ComplexArray:
    """Return a refit's baseline as an array, shape (S, K), T.

    Raises
    ------
    FitError
        When there are no references, their channels are not unique, or the shape is another.
    """
    given = np.asarray(baseline, dtype=np.complex128)
    if len(references) == 0:
        raise FitError('refit: there are no reference sensors')
    if given.shape != (len(references), len(model.emitters)):
        raise FitError(
            f'refit: {len(references)} references and {len(model.emitters)} emitters need a '
            f'baseline of that shape, got {given.shape}'
        )
    if len(set(references.channel.tolist())) != len(references):
        raise FitError('refit: a channel appears twice in the references')
    return given
