"""Searches forward for effects, scored on blocks that took no part in each fit.

A candidate is a name. What a set of names leaves on each held-out block is asked of the caller, so
the search knows no physics: it adds the name that explains most, as long as the gain stands clear
of its own scatter over the blocks, and takes one back when the others have made it idle.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Score = Callable[[tuple[str, ...]], Array]

CLEAR = 2.0
"""Standard errors (over the blocks) by which a gain must differ from zero."""
IDLE = 1.0
"""Standard errors below which an effect that was chosen before is taken back."""
LEAST_CHANGE = 0.01
"""Least change of the logarithm of the power, so that trifles stay out."""


@dataclass(frozen=True)
class CandidateTrial:
    """Records one candidate tried on top of others.

    Attributes
    ----------
    before : tuple of str
        The effects that were there already.
    name : str
        The candidate; empty for the start, with a leading minus for one that is left out.
    score : float
        Root of the mean held-out power.
    change : float
        Mean over the blocks of the logarithm of new over old power; negative is better. Blocks
        differ in power, and a ratio counts them alike.
    scatter : float
        Standard error of `change`, from its scatter over the blocks.
    chosen : bool
    """

    before: tuple[str, ...]
    name: str
    score: float
    change: float
    scatter: float
    chosen: bool


@dataclass(frozen=True)
class CandidateSearch:
    """Holds what the search chose, and everything it tried."""

    chosen: tuple[str, ...]
    trials: tuple[CandidateTrial, ...]
    start: float
    end: float


def _compare(
    before: tuple[str, ...], name: str, old: Array, new: Array, chosen: bool = False
) -> CandidateTrial:
    change = np.log(new / old)
    scatter = float(change.std(ddof=1) / np.sqrt(len(change))) if len(change) > 1 else 0.0
    return CandidateTrial(
        before, name, float(np.sqrt(new.mean())), float(change.mean()), scatter, chosen
    )


def _pays(trial: CandidateTrial) -> bool:
    return trial.change < -LEAST_CHANGE and trial.change < -CLEAR * trial.scatter


def _simplest(
    paying: Sequence[tuple[CandidateTrial, Array]], sizes: Mapping[str, int]
) -> tuple[CandidateTrial, Array]:
    """Of those that the blocks cannot distinguish from the best, the one of the fewest
    parameters."""
    best = min(paying, key=lambda item: item[0].change)
    alike = [p for p in paying if p[0].change <= best[0].change + best[0].scatter]
    return min(alike, key=lambda item: (sizes.get(item[0].name, 0), item[0].change))


def grow(
    names: Sequence[str],
    score: Score,
    sizes: Mapping[str, int] | None = None,
) -> CandidateSearch:
    """Add effects one at a time while they pay on held-out blocks; drop what became idle.

    Parameters
    ----------
    names : sequence of str
        The candidates.
    score : callable
        From a tuple of names to the mean squared residual of each held-out block, shape (B,).
    sizes : mapping, optional
        Number of parameters of each candidate: decides between those that score alike.

    Returns
    -------
    CandidateSearch
    """
    chosen: tuple[str, ...] = ()
    power = score(chosen)
    start = float(np.sqrt(power.mean()))
    trials: list[CandidateTrial] = []
    while True:
        tried = [
            (_compare(chosen, name, power, loss), loss)
            for name in names
            if name not in chosen
            for loss in (score((*chosen, name)),)
        ]
        paying = [item for item in tried if _pays(item[0])]
        best = _simplest(paying, sizes or {}) if paying else None
        trials += [
            _compare(t.before, t.name, power, loss, best is not None and t is best[0])
            for t, loss in tried
        ]
        if best is None:
            break
        chosen, power = (*chosen, best[0].name), best[1]
        chosen, power = _prune(chosen, power, score, trials)
    return CandidateSearch(chosen, tuple(trials), start, float(np.sqrt(power.mean())))


def _prune(
    chosen: tuple[str, ...], power: Array, score: Score, trials: list[CandidateTrial]
) -> tuple[tuple[str, ...], Array]:
    for name in chosen[:-1]:
        rest = tuple(other for other in chosen if other != name)
        loss = score(rest)
        trial = _compare(rest, name, loss, power)
        if trial.change > -LEAST_CHANGE or trial.change > -IDLE * trial.scatter:
            trials.append(_compare(chosen, f'-{name}', power, loss, chosen=True))
            chosen, power = rest, loss
    return chosen, power


def search_text(title: str, search: CandidateSearch, unit: str) -> str:
    """Return every candidate and its held-out score, as text."""
    lines = [
        f'{title}: held-out residual {search.start:.4g} {unit} at the start, '
        f'{search.end:.4g} {unit} with {", ".join(search.chosen) or "nothing"}',
        f'  {"candidate":<28} {"held-out, " + unit:>16} {"ln power":>9} {"+-":>6}  on top of',
    ]
    lines += [
        f'  {trial.name:<28} {trial.score:16.4g} {trial.change:+9.3f} '
        f'{trial.scatter:6.3f}  {", ".join(trial.before) or "-"}'
        f'{"  <- chosen" if trial.chosen else ""}'
        for trial in search.trials
    ]
    return '\n'.join(lines)
