"""Finds frames and single readings that stand out from their neighbours in time."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.effects.effect import Family

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WINDOW = 11
"""Neighbouring frames, this one among them, whose median an outlier stands out from: up to five
bad ones in a row are seen, and motion changes little over so many."""
READING_RATIO, FRAME_RATIO = 6.0, 2.5
"""Mean squares over the neighbours' median from which a reading (16 values with 8 emitters) or a
frame (ten times as many) is no member of the same distribution; normal noise in 8 values
or more passes less than once in 1e6. Of fewer values the ratio of so rare a noise is larger."""
RARE = 1e-6
"""Probability that noise alone makes so large a reading or frame."""
JUMP_RATIO = 40.0
"""Mean square over the neighbours' median from which a frame stands out whose pose's own
directions are left in: the optical jitter along them is larger than the noise and differs from
pose to pose, so only a glitch stands out so far. Smaller takes jitter for glitches, larger keeps
glitches in the fit. No more is known of its choice than that thresholds of the diagnosis were
chosen on seeds below 100 (`docs/log.md`)."""
PLACE_RATIO = 40.0
"""The same for readings and frames of a body that rested at each place for seconds: its neighbours
in time are centimetres away, and what the field's model misses differs between them. Over the
middle of a simulated board single readings of an older model had 6 to 18; a contact that fails
has thousands. Smaller takes a model's errors for loose contacts."""
WHOLE_FRAME_SHARE = 0.5
"""Share of a frame's readings, and of frames that lost any, from which whole frames are out: more
bad than good, so that what is left of the frame is not to be believed either."""
LEAST_CHANNEL_SHARE = 0.2
"""Share of the frames with an outlier from which a channel that has it is named: of nine channels
that are hit by chance each has a ninth."""


def find_outliers(state: State) -> tuple[Mask, ...]:
    """Return the mask (F, S) of outlying readings, one per tool; a frame that stands out is out as
    a whole.
    """
    masks = []
    moves = any(term.effect.family is Family.FLUCTUATION for term in state.terms)
    for part, tool, good in zip(
        state.parts, state.problem.tools, state.problem.good, strict=False
    ):
        emitters = state.problem.fields.omega.size
        # The residual along the pose's own directions is left in: an optical glitch shows there.
        size = (part.residual * part.whitener.weight) ** 2
        white = part.white**2
        readings = _by_reading(white, good.shape[1], emitters)
        count = np.maximum(good.sum(axis=1), 1)
        frames = np.where(good, readings, 0.0).sum(axis=1) / count
        jumps = np.where(good, _by_reading(size, good.shape[1], emitters), 0.0).sum(axis=1) / count
        values = _values(white, good.shape[1], emitters)
        of_reading = of_frame = PLACE_RATIO
        if tool.track is None or tool.is_followed:
            of_reading = _ratio(READING_RATIO, values)
            of_frame = _ratio(FRAME_RATIO, values * good.shape[1])
        bad = _stands_out(readings, of_reading) | _stands_out(frames[:, None], of_frame)
        if not moves:
            bad |= _stands_out(jumps[:, None], JUMP_RATIO)
        masks.append(bad & good)
    return tuple(masks)


def _by_reading(values: Array, sensors: int, emitters: int) -> Array:
    """Mean over the parts of each sensor's phasors that are anything, (F, S)."""
    shaped = values.reshape(values.shape[0], 2, sensors, emitters)
    return np.asarray(shaped.sum(axis=(1, 3)) / _values(values, sensors, emitters))


def _values(values: Array, sensors: int, emitters: int) -> int:
    """Parts of a reading that are anything: constant fields have no quadrature."""
    shaped = values.reshape(values.shape[0], 2, sensors, emitters)
    return max(int(shaped.any(axis=(0, 2)).sum()), 1)


def _ratio(usual: float, values: int) -> float:
    """Mean square of so many values beyond which it is no noise."""
    return max(usual, float(chdtri(values, RARE)) / values)


def _stands_out(values: Array, ratio: float) -> Mask:
    """Above ``ratio`` times the median of the neighbours in time, and above noise."""
    local = median_filter(values, size=(WINDOW, 1), mode='nearest')
    return np.asarray(values > ratio * np.maximum(local, 1.0))


def without_outliers(problem: Problem, state: State) -> Problem:
    """Return the problem with outlying readings left out."""
    masks = find_outliers(state)
    good = tuple(g & ~bad for g, bad in zip(problem.good, masks, strict=True))
    return replace(problem, good=good)


def outlying_share(before: Problem, after: Problem) -> tuple[float, list[int]]:
    """Return the share of frames that lost a reading, and the channels that lost most of them.

    The list is empty if whole frames are outliers.
    """
    lost_frames, frames = 0, 0
    by_channel: dict[int, int] = {}
    whole = 0
    for tool, old, new in zip(before.tools, before.good, after.good, strict=True):
        lost = old & ~new
        lost_frames += int(lost.any(axis=1).sum())
        whole += int((lost.sum(axis=1) > WHOLE_FRAME_SHARE * old.sum(axis=1).clip(1)).sum())
        frames += tool.time.size
        for row, channel in enumerate(tool.sensors.channel.tolist()):
            by_channel[channel] = int(lost[:, row].sum())
    share = lost_frames / max(frames, 1)
    if whole > WHOLE_FRAME_SHARE * max(lost_frames, 1):
        return share, []
    return share, [
        c for c, n in by_channel.items() if n > LEAST_CHANNEL_SHARE * max(lost_frames, 1)
    ]


def clean_start(problem: Problem) -> Problem:
    """Return the problem without what stands out before anything is explained."""
    return without_outliers(problem, evaluate(problem, ()))
