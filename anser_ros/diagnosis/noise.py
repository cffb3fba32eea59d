"""Finds frames that fit no model, and noise that has grown, once all else is explained."""

from collections.abc import Sequence

import numpy as np

from anser_ros.diagnosis.decisions import (
    FEWEST_OUTLIERS,
    KNOWN_SIGMAS,
    LEAST_NOISE_GROWTH,
    MOST_EXCESS_OF_OUTLIERS,
)
from anser_ros.diagnosis.finding import Finding, plain_finding
from anser_ros.diagnosis.outlying import outlying_share
from anser_ros.diagnosis.problem import Problem, State
from anser_ros.diagnosis.residuals import rms, tool_parts
from anser_ros.diagnosis.structure import noise_t
from anser_ros.effects.effect import Family
from anser_ros.effects.excess_noise import EXCESS_NOISE
from anser_ros.effects.outliers import known_share, outliers_of
from anser_ros.field.model import EffectRecord


def outlier_findings(
    whole: Problem,
    cleaned: Problem,
    after: State,
    excess: float,
    known: Sequence[EffectRecord] = (),
) -> list[Finding]:
    """Return outliers or a loose contact, where frames stand out and nothing else makes them.

    Parameters
    ----------
    whole, cleaned : Problem
        With and without the frames that stand out.
    after : State
        The held-out part with all effects.
    excess : float
        Power that is not explained, over the floor's.
    known : sequence of EffectRecord
        The model's. The share of frames that stood out in its own scan is what the optical tracker
        always does, and no effect of a session.
    """
    share, channels = outlying_share(whole, cleaned)
    # A fluctuation is taken for normal: frames far out along it are its own tails.
    own_tails = any(term.effect.family is Family.FLUCTUATION for term in after.terms)
    alone = excess < MOST_EXCESS_OF_OUTLIERS and not own_tails
    frames = sum(tool.time.size for tool in whole.tools)
    always = known_share(known)
    usual = always + KNOWN_SIGMAS * float(np.sqrt(always / max(frames, 1)))
    if share <= FEWEST_OUTLIERS + usual or not (channels or alone):
        return []
    sigma = float(np.sqrt(share / max(frames, 1)))
    return [plain_finding(outliers_of(share, sigma, channels), rms(after))]


def noise_findings(whole: Problem, after: State) -> list[Finding]:
    """Return excess noise, of all channels or of those that have it."""
    factor = noise_t(after) / whole.spread.noise_t
    if factor <= LEAST_NOISE_GROWTH:
        return []
    noisy = _noisy_channels(after)
    count: float = after.count
    if noisy:
        factor = _factor_of(after, noisy)
        count = after.count * len(noisy) / len(whole.apparatus.tool_channels)
    sigma = factor / np.sqrt(2 * max(count, 1))
    return [plain_finding(EXCESS_NOISE.seen(factor, sigma, noisy), rms(after))]


def _factor_of(state: State, channels: tuple[int, ...]) -> float:
    """Noise of some channels over what it should be."""
    squares, count = 0.0, 0
    for part in tool_parts(state):
        own = np.isin(part.view.sensors.channel, channels)
        size = (part.white * (part.whitener.weight > 0)).reshape(
            -1, 2, own.size, state.problem.fields.omega.size
        )[:, :, own]
        squares += float(np.sum(size**2))
        count += size.size
    spread = state.problem.spread
    return float(np.sqrt(squares / max(count, 1))) * spread.flux_t / spread.noise_t


def _noisy_channels(state: State) -> tuple[int, ...]:
    """Channels with grown noise, where others have none."""
    emitters = state.problem.fields.omega.size
    noisy, sound = [], 0
    for part in tool_parts(state):
        squares = part.white**2 * (part.whitener.weight > 0)
        sensors = len(part.view.sensors)
        size = squares.reshape(-1, 2, sensors, emitters).mean(axis=(0, 1, 3))
        for channel, value in zip(part.view.sensors.channel.tolist(), size, strict=True):
            if value > LEAST_NOISE_GROWTH**2:
                noisy.append(int(channel))
            else:
                sound += 1
    return tuple(noisy) if sound else ()
