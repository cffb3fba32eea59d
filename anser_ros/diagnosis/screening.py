"""Finds what needs no search: values that stand out from their neighbours, and wiring faults."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import chdtri

from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.problem import Problem, State, evaluate, tool_parts
from anser_ros.effects.effect import Family, Site, Term
from anser_ros.effects.wiring import DEAD_CHANNEL, SENSOR_POLARITY, SWAPPED_CHANNELS, SWAPPED_COILS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WINDOW = 11
"""Neighbouring frames whose median an outlier stands out from: up to five bad ones in a row."""


def without_outliers(problem: Problem, state: State) -> Problem:
    """Return the problem without readings and whole frames that stand out in a state of it."""
    kept = []
    moves = any(term.effect.family is Family.FLUCTUATION for term in state.terms)
    emitters = problem.fields.omega.size
    for part, tool, good in zip(state.parts, problem.tools, problem.good, strict=False):
        # The residual along the pose's own directions is left in: an optical glitch shows there.
        size = (part.residual * part.whitener.weight) ** 2
        white = part.white**2
        readings = _by_reading(white, good.shape[1], emitters)
        count = np.maximum(good.sum(axis=1), 1)
        frames = np.where(good, readings, 0.0).sum(axis=1) / count
        jumps = np.where(good, _by_reading(size, good.shape[1], emitters), 0.0).sum(axis=1) / count
        values = _values(white, good.shape[1], emitters)
        of_reading = of_frame = decisions.PLACE_RATIO
        if tool.track is None or tool.is_followed:
            of_reading = _ratio(decisions.READING_RATIO, values)
            of_frame = _ratio(decisions.FRAME_RATIO, values * good.shape[1])
        bad = _stands_out(readings, of_reading) | _stands_out(frames[:, None], of_frame)
        if not moves:
            bad |= _stands_out(jumps[:, None], decisions.JUMP_RATIO)
        kept.append(good & ~bad)
    return replace(problem, good=tuple(kept))


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
    return max(usual, float(chdtri(values, decisions.RARE)) / values)


def _stands_out(values: Array, ratio: float) -> Mask:
    """Above ``ratio`` times the median of the neighbours in time, and above noise."""
    local = median_filter(values, size=(WINDOW, 1), mode='nearest')
    return np.asarray(values > ratio * np.maximum(local, 1.0))


def outlying_share(before: Problem, after: Problem) -> tuple[float, list[int]]:
    """Return the share of frames that lost a reading, and the channels that lost most of them;
    no channels if whole frames are outliers.
    """
    lost_frames, frames, whole = 0, 0, 0
    by_channel: dict[int, int] = {}
    for tool, old, new in zip(before.tools, before.good, after.good, strict=True):
        lost = old & ~new
        lost_frames += int(lost.any(axis=1).sum())
        whole += int(
            (lost.sum(axis=1) > decisions.WHOLE_FRAME_SHARE * old.sum(axis=1).clip(1)).sum()
        )
        frames += tool.time.size
        by_channel |= dict(zip(tool.sensors.channel.tolist(), lost.sum(axis=0), strict=True))
    share = lost_frames / max(frames, 1)
    if whole > decisions.WHOLE_FRAME_SHARE * max(lost_frames, 1):
        return share, []
    return share, [
        c for c, n in by_channel.items() if n > decisions.LEAST_CHANNEL_SHARE * max(lost_frames, 1)
    ]


def clean_start(problem: Problem) -> Problem:
    """Return the problem without what stands out before anything is explained."""
    return without_outliers(problem, evaluate(problem, ()))


ComplexArray = NDArray[np.complex128]


def wiring_faults(problem: Problem) -> list[Term]:
    """Return terms for the wiring faults of the tools."""
    state = evaluate(problem, ())
    coils = _swapped_coils(state)
    if coils is not None:
        return [coils]
    faults: list[Term] = []
    dead: list[int] = []
    turned: list[int] = []
    for part, tool, usable in zip(tool_parts(state), problem.tools, problem.good, strict=False):
        channels, silent = tool.sensors.channel, _silent(tool.flux, part.view.flux, usable)
        dead += channels[silent].tolist()
        gain, alike = _likeness(tool.flux, part.view.flux, usable)
        own = np.diag(alike)
        turned += channels[
            (np.abs(np.diag(gain) + 1) < decisions.POLARITY_GAIN)
            & (own > decisions.OWN_CORRELATION)
            & ~silent
        ].tolist()
        order = np.argmax(alike, axis=1)
        moved = _moved(alike, ~silent)
        if moved.size:
            site: Site = {
                'channels': tuple(int(c) for c in channels[order[moved]]),
                'read_as': tuple(int(c) for c in channels[moved]),
            }
            faults.append(Term(SWAPPED_CHANNELS, site))
    dead += _silent_references(problem)
    if turned:
        faults.append(Term(SENSOR_POLARITY, {'channels': tuple(turned)}))
    if dead:
        faults.append(Term(DEAD_CHANNEL, {'channels': tuple(dead)}))
    return faults


def _silent_references(problem: Problem) -> list[int]:
    """Channels of references with hardly any of their clean reading."""
    if problem.references is None:
        return []
    readings, clean = problem.references.readings, problem.references.baseline
    wanted = np.broadcast_to(clean, readings.flux.shape)
    silent = _silent(readings.flux, wanted, readings.valid)
    return [int(c) for c in readings.sensors.channel[silent]]


def _silent(seen: ComplexArray, wanted: ComplexArray, good: Mask) -> Mask:
    """Mask (S,) of sensors with hardly any of the reading that they should have."""
    power = np.where(good[..., None], np.abs(seen) ** 2, 0.0).sum(axis=(0, 2))
    expected = np.where(good[..., None], np.abs(wanted) ** 2, 0.0).sum(axis=(0, 2))
    return np.asarray((power < decisions.DEAD**2 * expected) & (expected > 0))


def _likeness(seen: ComplexArray, wanted: ComplexArray, good: Mask) -> tuple[ComplexArray, Array]:
    """Gain and correlation of each sensor's readings with each one's prediction, (S, S)."""
    read = np.where(good[..., None], seen, 0.0)
    cross = np.einsum('ftk,fsk->st', wanted.conj(), read)
    power = np.einsum('ftk,fs->st', np.abs(wanted) ** 2, good.astype(float))
    own = np.sum(np.abs(read) ** 2, axis=(0, 2))
    gain = cross / np.where(power > 0, power, 1.0)
    return gain, np.abs(cross) / np.sqrt(np.maximum(power * own[:, None], 1e-300))


def _moved(alike: Array, is_driven: Mask) -> NDArray[np.int64]:
    """Rows that are plainly another's; none when they are no permutation."""
    rows = np.arange(len(alike))
    order, own = np.argmax(alike, axis=1), np.diag(alike)
    best = alike[rows, order]
    moved = rows[
        (order != rows)
        & is_driven
        & (best > decisions.OTHERS_CORRELATION)
        & (1 - best**2 < decisions.BETTER * (1 - own**2))
    ]
    return np.asarray(moved if set(order[moved]) == set(moved) else moved[:0])


def _swapped_coils(state: State) -> Term | None:
    """Emitters whose tones are like another's prediction, in all tools."""
    emitters = state.problem.fields.omega.size
    cross = np.zeros((emitters, emitters), dtype=complex)
    power, own = np.zeros(emitters), np.zeros(emitters)
    problem = state.problem
    for part, tool, good in zip(tool_parts(state), problem.tools, problem.good, strict=False):
        read = np.where(good[..., None], tool.flux, 0.0)
        wanted = np.where(good[..., None], part.view.flux, 0.0)
        cross += np.einsum('fsb,fsa->ab', wanted.conj(), read)
        power += np.sum(np.abs(wanted) ** 2, axis=(0, 1))
        own += np.sum(np.abs(read) ** 2, axis=(0, 1))
    alike = np.abs(cross) / np.sqrt(np.maximum(own[:, None] * power[None, :], 1e-300))
    order, moved = np.argmax(alike, axis=1), _moved(alike, np.ones(emitters, dtype=bool))
    if not moved.size:
        return None
    true = tuple(int(c) for c in order[moved])
    return Term(SWAPPED_COILS, {'coils': true, 'read_as': tuple(moved.tolist())})
