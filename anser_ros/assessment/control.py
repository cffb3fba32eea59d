"""Compares repeated assessments with control limits: pass, note, alert or fail.

A figure's limits are those of Shewhart's chart of individual values: the mean of earlier sessions,
and multiples of the deviation that neighbouring sessions show (the mean of their differences over
1.128). The multiples are those of two and three deviations of a known law, made larger to allow
for few sessions (Student's t) and for the number of figures that are watched (Bonferroni), so that
a session in control is a note once in 22 times and an alert once in 370. A stated tolerance is a
separate limit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import stats

PASS, NOTE, ALERT, FAIL = 'pass', 'note', 'alert', 'fail'
STATES = (PASS, NOTE, ALERT, FAIL)
"""From good to bad; a whole session is as bad as its worst figure."""
FEWEST_SESSIONS = 5
"""Earlier sessions without which there are no limits: those of fewer are chance."""
WARNING, ACTION = 2.0, 3.0
"""Deviations of a known normal law from which a figure is a note, and an alert."""
FREEDOMS = 0.62
"""Degrees of freedom of a deviation from differences of neighbours, a session beyond the first: so
much less do they tell than the sum of squares would."""
RUN = 8
"""Sessions in a row on one side of the mean that are a note: chance makes it once in 256."""
DIFFERENCE = 1.128
"""Mean of the difference of two normal values over their deviation."""
SMALLEST_SHARE = 0.02
"""Least standard deviation that limits are made with, as a share of the mean: sessions that happen
to be alike do not make limits that the next one must break."""


@dataclass(frozen=True)
class ControlLimits:
    """Holds the limits of one figure.

    Attributes
    ----------
    n : int
        Earlier sessions they are made from.
    mean, sigma : float
    note, alert : float
        Distance from the mean, in the figure's unit, from which on a session is a note, and an
        alert.
    """

    n: int
    mean: float
    sigma: float
    note: float
    alert: float


@cache
def _multiple(count: int, deviations: float, figures: int) -> float:
    """Deviations that a figure in order may be off the mean, for one of so many."""
    share = 2 * stats.norm.sf(deviations) / figures
    wide = stats.t.isf(share / 2, max(FREEDOMS * (count - 1), 1.0))
    return float(wide * np.sqrt(1 + 1 / count))


@dataclass(frozen=True)
class Verdict:
    """Judges a figure by those of earlier sessions.

    Attributes
    ----------
    state : str
        One of `STATES`.
    words : str
        Why, or that there are no limits yet; empty where it passes by limits.
    limits : ControlLimits or None
        None while there are too few sessions.
    tolerance : float or None
        What was stated.
    """

    state: str
    words: str
    limits: ControlLimits | None
    tolerance: float | None


def limits_of(earlier: Sequence[float], figures: int = 1) -> ControlLimits | None:
    """Return limits from the figures of earlier sessions, in their order.

    Parameters
    ----------
    earlier : sequence of float
    figures : int
        How many figures are watched at once, this one with them.
    """
    values = np.asarray(earlier, dtype=np.float64)
    values = values[np.isfinite(values)]
    if values.size < FEWEST_SESSIONS:
        return None
    mean = float(values.mean())
    sigma = float(np.mean(np.abs(np.diff(values)))) / DIFFERENCE
    sigma = max(sigma, SMALLEST_SHARE * abs(mean), 1e-12)
    note, alert = (sigma * _multiple(values.size, d, figures) for d in (WARNING, ACTION))
    return ControlLimits(int(values.size), mean, sigma, note, alert)


def judged(
    value: float, earlier: Sequence[float], tolerance: float | None = None, figures: int = 1
) -> Verdict:
    """Return what a figure is worth.

    Parameters
    ----------
    value : float
    earlier : sequence of float
        The same figure of sessions that were in order, the oldest first.
    tolerance : float, optional
        Largest size that it may have.
    figures : int
        How many figures are watched with it.
    """
    limits = limits_of(earlier, figures)
    if not np.isfinite(value):
        return Verdict(FAIL, 'no figure', limits, tolerance)
    if tolerance is not None and abs(value) > tolerance:
        return Verdict(FAIL, f'beyond the tolerance of {tolerance:.4g}', limits, tolerance)
    if limits is None:
        words = f'{len(earlier)} of {FEWEST_SESSIONS} sessions that control limits need'
        return Verdict(PASS, words, None, tolerance)
    off = value - limits.mean
    side = 'above' if off > 0 else 'below'
    for state, reach in ((ALERT, limits.alert), (NOTE, limits.note)):
        if abs(off) > reach:
            words = (
                f'{abs(off) / limits.sigma:.1f} standard deviations {side} the mean '
                f'({state} from {reach / limits.sigma:.1f} on)'
            )
            return Verdict(state, words, limits, tolerance)
    last = np.sign(np.array([*earlier, value])[-RUN:] - limits.mean)
    if last.size == RUN and abs(last.sum()) == RUN:
        return Verdict(NOTE, f'{RUN} sessions in a row on one side of the mean', limits, tolerance)
    return Verdict(PASS, '', limits, tolerance)


def worst(verdicts: Mapping[str, Verdict]) -> str:
    """Return the worst state of the verdicts, which is the session's."""
    return max((v.state for v in verdicts.values()), key=STATES.index, default=PASS)
