"""Repeated assessments against control limits: pass, note, alert or fail.

A figure's limits are those of Shewhart's chart of individual values: the mean of earlier
sessions, and two and three times the deviation that neighbouring sessions show (the mean of their
differences over 1.128). A tolerance that is stated is a limit of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

PASS, NOTE, ALERT, FAIL = 'pass', 'note', 'alert', 'fail'
STATES = (PASS, NOTE, ALERT, FAIL)
"""From good to bad; a whole session is as bad as its worst figure."""
FEWEST = 5
"""Earlier sessions without which there are no limits: those of fewer are chance."""
WARNING, ACTION = 2.0, 3.0
"""Deviations from the mean from which a figure is a note, and an alert."""
RUN = 8
"""Sessions in a row on one side of the mean that are a note: chance makes it once in 256."""
DIFFERENCE = 1.128
"""Mean of the difference of two normal values over their deviation."""
SMALLEST_SHARE = 0.02
"""Least deviation that is taken, in the mean: sessions that happen to be alike are no law."""


@dataclass(frozen=True)
class ControlLimits:
    """Limits of one figure.

    Attributes
    ----------
    n : int
        Earlier sessions they are made from.
    mean, sigma : float
    """

    n: int
    mean: float
    sigma: float


@dataclass(frozen=True)
class Verdict:
    """What a figure is worth beside those of earlier sessions.

    Attributes
    ----------
    state : str
        One of `STATES`.
    words : str
        Why; empty where it passes.
    limits : ControlLimits or None
        None while there are too few sessions.
    tolerance : float or None
        What was stated.
    """

    state: str
    words: str
    limits: ControlLimits | None
    tolerance: float | None


def limits_of(earlier: Sequence[float]) -> ControlLimits | None:
    """Limits from the figures of earlier sessions, in their order."""
    values = np.asarray(earlier, dtype=np.float64)
    values = values[np.isfinite(values)]
    if values.size < FEWEST:
        return None
    mean = float(values.mean())
    sigma = float(np.mean(np.abs(np.diff(values)))) / DIFFERENCE
    return ControlLimits(int(values.size), mean, max(sigma, SMALLEST_SHARE * abs(mean), 1e-12))


def judged(value: float, earlier: Sequence[float], tolerance: float | None = None) -> Verdict:
    """What a figure is worth.

    Parameters
    ----------
    value : float
    earlier : sequence of float
        The same figure of sessions that were in order, the oldest first.
    tolerance : float, optional
        Largest size that it may have.
    """
    limits = limits_of(earlier)
    if not np.isfinite(value):
        return Verdict(FAIL, 'no figure', limits, tolerance)
    if tolerance is not None and abs(value) > tolerance:
        return Verdict(FAIL, f'beyond the tolerance of {tolerance:.4g}', limits, tolerance)
    if limits is None:
        return Verdict(
            PASS, f'{len(earlier)} of {FEWEST} sessions that make limits', None, tolerance
        )
    off = (value - limits.mean) / limits.sigma
    words = f'{abs(off):.1f} deviations {"above" if off > 0 else "below"} the mean'
    if abs(off) > ACTION:
        return Verdict(ALERT, words, limits, tolerance)
    if abs(off) > WARNING:
        return Verdict(NOTE, words, limits, tolerance)
    last = np.sign(np.array([*earlier, value])[-RUN:] - limits.mean)
    if last.size == RUN and abs(last.sum()) == RUN:
        return Verdict(NOTE, f'{RUN} sessions in a row on one side of the mean', limits, tolerance)
    return Verdict(PASS, '', limits, tolerance)


def worst(verdicts: Mapping[str, Verdict]) -> str:
    """The state of a session."""
    return max((v.state for v in verdicts.values()), key=STATES.index, default=PASS)
