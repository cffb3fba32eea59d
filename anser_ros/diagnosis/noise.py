"""Finds frames that fit no model, and noise that has grown, once all else is explained."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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

Array = NDArray[np.float64]


def outlier_findings(
    whole: Problem,
    cleaned: Problem,
    after: State,
    excess: float,
    known: Sequence[EffectRecord] = (),
) -> list[Finding]:
    """Return outliers or a loose contact, where frames stand out and nothing else makes them.

    ``whole`` and ``cleaned``: with and without the frames that stand out; ``after``: the held-out
    part with all effects; ``excess``: power that is not explained, over the floor's; ``known``:
    the model's. The share of frames that stood out in its own scan is what the optical tracker
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
    squares: dict[int, Array] = {}
    for part in tool_parts(after):
        square = part.white**2 * (part.whitener.weight > 0)
        cells = square.reshape(-1, 2, *part.view.flux.shape[1:])
        for row, channel in enumerate(part.view.sensors.channel.tolist()):
            squares[channel] = cells[:, :, row]
    noisy = [c for c, values in squares.items() if values.mean() > LEAST_NOISE_GROWTH**2]
    if len(noisy) == len(squares):  # where no others have none, it is that of all
        noisy = []
    count: float = after.count
    if noisy:
        total = sum(float(squares[c].sum()) for c in noisy)
        size = np.sqrt(total / sum(squares[c].size for c in noisy))
        factor = float(size) * whole.spread.flux_t / whole.spread.noise_t
        count *= len(noisy) / len(whole.apparatus.tool_channels)
    sigma = factor / np.sqrt(2 * max(count, 1))
    return [plain_finding(EXCESS_NOISE.seen(factor, sigma, tuple(noisy)), rms(after))]
