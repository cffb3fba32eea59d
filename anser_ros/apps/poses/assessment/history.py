"""Keeps earlier assessments in a folder, a small file each, and judges a new one by control
limits.

A figure is compared with those of the same protocol and body in earlier sessions; the limits are
those of a control chart of individual values.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from anser_ros.apps.poses.assessment.protocols import WATCHED, Assessment
from anser_ros.errors import ParameterError

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
"""Least standard deviation of limits, as a share of the mean: sessions may happen to be alike."""


class ControlLimits(NamedTuple):
    """Holds the limits of one figure."""

    n: int  # earlier sessions they are made from
    mean: float
    sigma: float
    note: float  # distance from the mean from which on a session is a note
    alert: float  # and an alert


@cache
def _multiple(count: int, deviations: float, figures: int) -> float:
    """Deviations that a figure in order may be off the mean, for one of so many."""
    share = 2 * stats.norm.sf(deviations) / figures
    wide = stats.t.isf(share / 2, max(FREEDOMS * (count - 1), 1.0))
    return float(wide * np.sqrt(1 + 1 / count))


@dataclass(frozen=True)
class Verdict:
    """Judges a figure by those of earlier sessions."""

    state: str  # one of `STATES`
    words: str  # why, or that there are no limits yet; empty where it passes by limits
    limits: ControlLimits | None  # none while there are too few sessions
    tolerance: float | None  # what was stated


def limits_of(earlier: Sequence[float], figures: int = 1) -> ControlLimits | None:
    """Return limits from the figures of earlier sessions, in their order.

    ``figures``: how many are watched at once, this one with them.
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

    ``earlier``: the same figure of sessions that were in order, the oldest first; ``tolerance``:
    largest size that it may have; ``figures``: how many are watched with it.
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


SCHEMA = 'anser_accuracy_history/1'


@dataclass(frozen=True)
class EarlierFigure:
    """Holds a figure of an earlier session: when the session began, ns, value, and state there."""

    start_ns: int
    value: float
    state: str

    @property
    def is_in_order(self) -> bool:
        """Return whether limits are made with it."""
        return self.state not in (ALERT, FAIL)


@dataclass(frozen=True)
class SessionVerdict:
    """Holds the verdict on a session."""

    state: str  # that of its worst figure
    figures: dict[str, Verdict]  # by figure
    sessions: int  # earlier sessions of the same protocol and body
    # watched figures in those sessions, the oldest first
    past: dict[str, tuple[EarlierFigure, ...]]


def figures_of(found: Assessment) -> dict[str, float]:
    """Return all figures of an assessment by name; of groups their mean and root mean square."""
    figures = {name: estimate.value for name, estimate in found.estimates.items()}
    for name, group in found.groups.items():
        figures |= {f'{name}/{key}': group.summary[key].value for key in ('Mean', 'RMS')}
    return figures


def judge(
    found: Assessment, folder: Path | None, tolerances: Mapping[str, float]
) -> SessionVerdict:
    """Return the verdict on a session by the history in a folder, or by tolerances alone.

    Sessions of the same protocol and body count, but no later ones, and no figure that was an
    alert or failed in its session. ``tolerances``: largest size by figure. Raises `ParameterError`
    when a tolerance is for an unknown figure, or a file is not of a history.
    """
    figures = figures_of(found)
    unknown = sorted(set(tolerances) - set(figures))
    if unknown:
        raise ParameterError(f'no figure {unknown[0]!r}; there are: {", ".join(figures)}')
    entries = [] if folder is None else _entries(folder, found)
    earlier = [entry for entry in entries if entry['start_ns'] < found.start_ns]
    words = WATCHED[found.protocol]
    watched = [n for n in figures if n.startswith(words) or n.endswith(words)]
    past = {
        name: tuple(
            EarlierFigure(
                int(e['start_ns']), float(e['figures'][name]), e['states'].get(name, PASS)
            )
            for e in earlier
            if e['figures'].get(name) is not None
        )
        for name in watched
    }
    verdicts = {}
    for name in [*watched, *(n for n in tolerances if n not in watched)]:
        values = [one.value for one in past.get(name, ()) if one.is_in_order]
        verdicts[name] = judged(figures[name], values, tolerances.get(name), len(watched))
    state = max((v.state for v in verdicts.values()), key=STATES.index, default=PASS)
    return SessionVerdict(state, verdicts, len(earlier), past)


def keep(found: Assessment, folder: Path, verdicts: Mapping[str, Verdict]) -> Path:
    """Write a session into the history; the same recording again takes its own place."""
    figures = figures_of(found)
    document = {
        'schema': SCHEMA, 'protocol': found.protocol, 'body': found.body,
        'start_ns': found.start_ns, 'recordings': list(found.recordings),
        'figures': {name: v if np.isfinite(v) else None for name, v in figures.items()},
        'states': {name: verdict.state for name, verdict in verdicts.items()},
    }  # fmt: skip
    body = re.sub(r'[^A-Za-z0-9_]+', '_', found.body)
    path = folder / f'{found.start_ns}_{found.protocol}_{body}.json'
    path.write_text(json.dumps(document, indent=1) + '\n', encoding='utf-8')
    return path


def _entries(folder: Path, found: Assessment) -> list[dict[str, Any]]:
    """Entries of the same protocol and body, the oldest first."""
    entries = []
    for path in sorted(folder.glob('*.json')):
        try:
            entry = json.loads(path.read_text(encoding='utf-8'))
            wanted = entry['schema'] == SCHEMA
            same = (entry['protocol'], entry['body']) == (found.protocol, found.body)
            complete = {'start_ns', 'figures', 'states'} <= entry.keys()
        except (ValueError, KeyError, TypeError) as error:
            raise ParameterError(f'{path}: not an entry of a history') from error
        if not (wanted and complete):
            raise ParameterError(f'{path}: not an entry of a history, {SCHEMA}')
        if same:
            entries.append(entry)
    return sorted(entries, key=lambda entry: int(entry['start_ns']))
