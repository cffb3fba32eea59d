"""Finds frames and single readings that stand out from their neighbours in time."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from anser_ros.diagnosis.decisions import (
    FRAME_RATIO,
    JUMP_RATIO,
    LEAST_CHANNEL_SHARE,
    PLACE_RATIO,
    RARE,
    READING_RATIO,
    WHOLE_FRAME_SHARE,
)
from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.effects.effect import Family

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WINDOW = 11
"""Neighbouring frames, this one among them, whose median an outlier stands out from: up to five
bad ones in a row are seen, and motion changes little over so many."""


def find_outliers(state: State) -> tuple[Mask, ...]:
    """Return masks (F, S) of outlying readings, one per tool; or of whole frames."""
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
