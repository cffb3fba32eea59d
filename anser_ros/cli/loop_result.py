"""Holds results of a loop: truth and finding, their parameters, the errors of the second run."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from anser_ros.cli.loop_run import AFTER, BEFORE, UNGATED
from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import DEGREES
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.recorded_health import last_words, ok_share
from anser_ros.sessions.recorded_poses import LiveErrors, live_errors
from anser_ros.sessions.session import Session

NAMED, PARTLY, UNEXPLAINED = 'named', 'named in part', 'said unexplained'
MISSED, WRONG = 'missed', 'wrong name'
SITES = ('channel', 'channels', 'coil', 'coils')
TRACKERS = ('ungated', 'before', 'after')


def verdict(truth: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> str:
    """Return how right a diagnosis is; empty for a clean run that was found clean.

    An effect that the diagnosis knows must be named, at its site, and nothing else. One that it
    does not know must be reported as unexplained: completely, or in part among other names.

    ``truth`` has name, parameters and answers of the effect that was put in, ``diagnosis`` is the
    document of the diagnosis.
    """
    names = [effect['name'] for effect in diagnosis['effects']]
    unexplained = diagnosis['unexplained']['fraction'] > 0.0
    answers = list(truth['answers'])
    if truth['name'] == 'none':
        return WRONG if names else ''
    if answers and names and set(names) <= set(answers):
        same = all(_same_site(truth['parameters'], e['parameters']) for e in diagnosis['effects'])
        return NAMED if same else WRONG
    if not names:
        return UNEXPLAINED if unexplained else MISSED
    return PARTLY if unexplained and not answers else WRONG


def _same_site(truth: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    return all(found[key] == truth[key] for key in SITES if key in truth and key in found)


def parameter_errors(truth: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """Return each parameter that truth and finding share, with its error and standard deviation.

    The error of a list is its largest difference, that of a position the distance.
    """
    out: dict[str, Any] = {}
    for effect in diagnosis['effects']:
        if effect['name'] not in truth['answers']:
            continue
        for key, put_in in truth['parameters'].items():
            found = effect['parameters'].get(key)
            if key in SITES or found is None or np.shape(found) != np.shape(put_in):
                continue
            difference = np.asarray(found, float) - np.asarray(put_in, float)
            size = np.linalg.norm if key == 'position_m' else lambda d: np.abs(d).max()
            out[key] = {
                'put_in': put_in,
                'found': found,
                'error': float(size(difference)),
                'sigma': effect['uncertainty'].get(key),
            }
    return out


def second_run(session: Session, corrected: FieldModel, known: FieldModel) -> dict[str, Any]:
    """Return each tracker's live errors over all sensors and bodies, and its share of poses.

    A tracker with a wrong model withholds the poses that its gate catches, so that its error must
    be judged together with the share of poses that it published of those that it judged;
    `ungated` has the withheld poses as well.
    """
    figures, words = {}, last_words(session.path)
    for name, namespace, model in (
        ('ungated', UNGATED, known), ('before', BEFORE, known), ('after', AFTER, corrected)
    ):  # fmt: skip
        errors = list(live_errors(prepare(session, model), namespace).values())
        share = ok_share(words, f'{namespace}/tracker'.strip('/'))
        figures[name] = {'published_share': share, **_figures(errors)}
    return figures


def _figures(errors: list[LiveErrors]) -> dict[str, float | None]:
    out: dict[str, float | None] = {}
    for key, unit in (('position', 'm'), ('orientation', 'rad')):
        values = np.concatenate([getattr(error, key) for error in errors])
        has = bool(values.size)
        out[f'{key}_rmse_{unit}'] = float(np.sqrt(np.mean(values**2))) if has else None
        out[f'{key}_prc95_{unit}'] = float(np.percentile(values, 95)) if has else None
    return out


def table(rounds: list[dict[str, Any]], console: Console) -> None:
    """Print a line for every round, and the signs of an overloaded machine."""
    out = Table(title='live error of the second run, on another path (simulated)')
    for heading in ('put in', 'found', 'verdict', 'parameters'):
        out.add_column(heading, overflow='fold')
    for heading in ('no gate\nmm', 'before\nmm', 'after\nmm', 'before\ndeg', 'after\ndeg'):
        out.add_column(heading, justify='right')
    for heading in ('published\nbefore', 'published\nafter', 'unexplained'):
        out.add_column(heading, justify='right')
    for one in rounds:
        live, hidden = one['second_run_live'], one['too_busy']
        out.add_row(
            one['truth']['name'],
            ', '.join(effect['name'] for effect in one['found']) or '-',
            'machine too busy' if hidden else one['verdict'],
            '\n'.join(_parameter(key, value) for key, value in one['parameters'].items()),
            *(_number(live[n]['position_rmse_m'], 1e3, hidden) for n in TRACKERS),
            *(_number(live[n]['orientation_rmse_rad'], DEGREES, hidden) for n in TRACKERS[1:]),
            *(f'{100 * live[n]["published_share"]:.1f} %' for n in TRACKERS[1:]),
            f'{100 * one["unexplained"]["fraction"]:.2g} %',
        )
    console.print(out)
    for number, one in enumerate(rounds, 1):
        for name, after_s in one['watcher_said_after_s'].items():
            text = (
                f'round {number}: the watcher reported {name} {after_s:.0f} s after the first flux'
            )
            console.print(text, highlight=False)
    for number, one in enumerate(rounds, 1):
        for name, signs in one['machine'].items():
            text = '; '.join(signs)
            console.print(f'round {number}, {name} run: {text}', style='yellow', highlight=False)


def _number(value: float | None, scale: float, hidden: bool) -> str:
    return '-' if value is None or hidden else f'{scale * value:.3f}'


def _parameter(key: str, value: Mapping[str, Any]) -> str:
    error, sigma = value['error'], value['sigma']
    if np.ndim(value['found']):
        return f'{key}: off by {error:.2g}'
    text = f'{key}: {value["put_in"]:.5g} put in, {value["found"]:.5g} found'
    return text + (f' (1 sigma {sigma:.1g})' if isinstance(sigma, float) else '')
