"""Keeps earlier assessments in a folder, a small file each, and gives the verdict on a new one."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from anser_ros.assessment.control import ALERT, FAIL, PASS, Verdict, judged, worst
from anser_ros.assessment.protocols import WATCHED, Assessment
from anser_ros.errors import ParameterError

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
    """Holds the verdict on a session.

    Attributes
    ----------
    state : str
        That of its worst figure.
    figures : dict of str to Verdict
        By figure.
    sessions : int
        Earlier sessions of the same protocol and body.
    past : dict of str to tuple of EarlierFigure
        Watched figures in those sessions, the oldest first.
    """

    state: str
    figures: dict[str, Verdict]
    sessions: int
    past: dict[str, tuple[EarlierFigure, ...]]


def figures_of(found: Assessment) -> dict[str, float]:
    """Return all figures of an assessment by name; of groups their mean and root mean square."""
    figures = {name: estimate.value for name, estimate in found.estimates.items()}
    for name, group in found.groups.items():
        figures |= {f'{name}/{key}': group.summary[key].value for key in ('Mean', 'RMS')}
    return figures


def _is_watched(name: str, protocol: str) -> bool:
    return any(name.startswith(w) or name.endswith(w) for w in WATCHED[protocol])


def judge(
    found: Assessment, folder: Path | None, tolerances: Mapping[str, float]
) -> SessionVerdict:
    """Return the verdict on a session.

    Sessions of the same protocol and body count, but no later ones, and no figure that was an
    alert or failed in its session.

    Parameters
    ----------
    found : Assessment
    folder : Path or None
        Of the history; None: tolerances alone.
    tolerances : mapping of str to float
        Largest size by figure.

    Raises
    ------
    ParameterError
        When a tolerance is for an unknown figure, or a file is not of a history.
    """
    figures = figures_of(found)
    unknown = sorted(set(tolerances) - set(figures))
    if unknown:
        raise ParameterError(f'no figure {unknown[0]!r}; there are: {", ".join(figures)}')
    entries = [] if folder is None else _entries(folder, found)
    earlier = [entry for entry in entries if entry['start_ns'] < found.start_ns]
    watched = [n for n in figures if _is_watched(n, found.protocol)]
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
    return SessionVerdict(worst(verdicts), verdicts, len(earlier), past)


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
