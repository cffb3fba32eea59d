"""The diagnosis as one self-contained page for readers who do not know the code."""

import base64
import html
import io
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use('Agg')
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Part, State
from anser_ros.diagnosis.search import Candidate
from anser_ros.sessions.diagnosis import SessionDiagnosis

Array = NDArray[np.float64]

# Candidates of a round that the page lists at most, to keep it short.
MOST_CANDIDATES = 40
BEFORE, AFTER = '#c44e52', '#4c72b0'
STYLE = """
body { font: 15px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .25em .8em; text-align: left;
border-bottom: 1px solid #ddd; vertical-align: top } th { background: #f4f4f4 }
img { max-width: 100% }
.verdict { background: #eef3fa; padding: 1em; border-left: 4px solid #4c72b0 }
td.n { text-align: right; font-variant-numeric: tabular-nums } code { background: #f4f4f4 }
.note { color: #666 }
"""


def verdict(document: dict[str, Any]) -> str:
    """Return in one paragraph what the diagnosis found."""
    held, effects = document['held_out'], document['effects']
    before, after = held['flux_rms_before_t'], held['flux_rms_after_t']
    if effects:
        names = ', '.join(_named(effect) for effect in effects)
        text = (
            f'The model lacks {len(effects)} effect{"s" if len(effects) > 1 else ""}: {names}. '
            f'With {"them" if len(effects) > 1 else "it"} the residual on data that took no part '
            f'falls from {1e12 * before:.0f} to {1e12 * after:.0f} pT'
        )
        pair = held['position_rmse_before_m'], held['position_rmse_after_m']
        if None not in pair:
            text += f', and the position error from {1e3 * pair[0]:.3g} to {1e3 * pair[1]:.3g} mm'
        text += '.'
    else:
        floor = 1e12 * held['flux_rms_floor_t']
        text = 'No effect that is known here explains what this session shows: '
        if document['unexplained']['fraction'] == 0:
            text = 'The model explains this session, and no effect is needed: '
        text += (
            f'the residual on held-out data is {1e12 * after:.0f} pT, the noise {floor:.0f} pT.'
        )
    rest = document['unexplained']
    if rest['fraction'] > 0:
        on = ', '.join(rest['depends_on']) or 'nothing that was looked at'
        share = f'{rest["fraction"]:.0%}' if rest['fraction'] >= 0.01 else 'Less than 1%'
        text += f' {share} of the power above the noise stays unexplained; it depends on {on}.'
    else:
        text += ' Nothing above the noise stays unexplained.'
    return text


def _named(effect: dict[str, Any]) -> str:
    shown = ', '.join(f'{key} {_value(value)}' for key, value in _short(effect['parameters']))
    return f'{effect["name"]} ({shown})' if shown else str(effect['name'])


def _short(parameters: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return the parameters that fit on a line, without long lists."""
    return [(key, value) for key, value in parameters.items() if _size(value) <= 9]


def _size(value: Any) -> int:
    return sum(_size(item) for item in value) if isinstance(value, list) else 1


def _value(value: Any) -> str:
    if isinstance(value, list):
        return '[' + ', '.join(_value(item) for item in value) + ']'
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def render(result: SessionDiagnosis, document: dict[str, Any], *, session: str, model: str) -> str:
    """Return the page as HTML with its figures inside.

    Parameters
    ----------
    result : SessionDiagnosis
    document : mapping
        As it is in diagnosis.json.
    session, model : str
        What was diagnosed.
    """
    found = result.diagnosis
    sections = [
        f'<h1>Diagnosis</h1><p class="note">session <code>{html.escape(session)}</code>, '
        f'model <code>{html.escape(model)}</code></p>',
        f'<p class="verdict">{html.escape(verdict(document))}</p>',
        '<h2>Before and after</h2><p>Measured on every fifth stretch of time, which took no part '
        'in choosing or fitting. Each frame&#39;s optical jitter, which moves all channels '
        'together, is taken out of the flux residual.</p>',
        _held_out(document),
        '<h2>Effects</h2>',
        _effects(document),
        '<h2>Residuals over time</h2><p>In the pictures 1 is what noise alone would give.</p>',
        _image(_time_line(found.before, found.after)),
        '<h2>Residuals over the volume</h2>',
        _image(_maps(found.before, found.after)),
        '<h2>Residuals by channel and emitter</h2>',
        _image(_bars(found.before, found.after)),
        '<h2>What stays unexplained</h2>',
        _structure(result),
        '<h2>Every candidate</h2>',
        _candidates(found.search.rounds),
        _left_out(result),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Diagnosis</title>'
        f'<style>{STYLE}</style></head><body>{"".join(sections)}</body></html>\n'
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    cells = ''.join(f'<th>{html.escape(cell)}</th>' for cell in head)
    body = ''.join(
        '<tr>' + ''.join(f'<td>{html.escape(cell)}</td>' for cell in row) + '</tr>' for row in rows
    )
    return f'<table><tr>{cells}</tr>{body}</table>'


def _held_out(document: dict[str, Any]) -> str:
    held = document['held_out']
    rows = []
    for label, key, unit, scale in (
        ('flux residual, pT rms', 'flux_rms', 't', 1e12),
        ('position RMSE of the coils, mm', 'position_rmse', 'm', 1e3),
        ('orientation RMSE of the coils, deg', 'orientation_rmse', 'rad', 57.29578),
    ):
        pair = [held[f'{key}_{when}_{unit}'] for when in ('before', 'after')]
        rows.append([label, *('-' if v is None else f'{scale * v:.4g}' for v in pair)])
    rows.append(['noise floor of the flux, pT rms', '', f'{1e12 * held["flux_rms_floor_t"]:.4g}'])
    return _table(['', 'before', 'after'], rows)


def _effects(document: dict[str, Any]) -> str:
    if not document['effects']:
        if document['unexplained']['fraction'] > 0:
            return (
                '<p>None is named: what explained something was not the same in all parts of the '
                'data, or left too much where it acts (see below, refused). Nothing is corrected; '
                'a wrong correction would be worse than none.</p>'
            )
        return '<p>None. A clean session passes every test and is not corrected.</p>'
    rows = []
    for effect in document['effects']:
        values = '\n'.join(f'{k} = {_value(v)}' for k, v in _short(effect['parameters']))
        sigmas = '\n'.join(f'{k} ± {_value(v)}' for k, v in _short(effect['uncertainty']))
        evidence = effect['evidence']
        rivals = ', '.join(evidence.get('rivals') or []) or 'none'
        rows.append(
            [
                effect['name'],
                str(evidence.get('summary', '')),
                values,
                sigmas,
                f'{1e12 * effect["flux_rms_without_t"]:.4g}',
                rivals,
                str(evidence.get('remedy', '')),
            ]
        )
    head = ['effect', 'what it is', 'parameters', '1 sigma', 'residual without it, pT',
            'explains nearly as much', 'online']  # fmt: skip
    return _table(head, rows).replace('\n', '<br>')


def _structure(result: SessionDiagnosis) -> str:
    found = result.diagnosis
    rows = [
        [
            test.variable,
            f'{other.share:.2%}',
            f'{test.share:.2%}',
            f'{test.probability:.2g}',
            'yes' if test.variable in found.depends_on else 'trace' if test.significant else 'no',
        ]
        for test in found.tests_after
        for other in found.tests_before
        if other.variable == test.variable
    ]
    head = ['residual against', 'share before', 'share after', 'chance of that in noise', 'left?']
    text = '<p>Share of the residual power that follows each variable beyond chance. A trace is '
    text += 'plain to see, but too small to matter.</p>'
    if found.unexplained > 0:
        text += f'<p>{html.escape(_strongest(found.after))}</p>'
    return text + _table(head, rows)


def _strongest(state: State) -> str:
    """Return in words where the residual is largest."""
    largest = []
    parts = _tools(state)
    emitters = state.problem.fields.omega.size
    for kind, axis in (('channel', 1), ('emitter', 2)):
        sizes: dict[int, float] = {}
        for part in parts:
            channels = part.view.sensors.channel
            cells = _rms(part, 0).reshape(2, len(channels), emitters)
            values = np.sqrt(np.mean(cells**2, axis=(0, 3 - axis)))
            names = channels.tolist() if kind == 'channel' else range(emitters)
            for name, value in zip(names, values.tolist(), strict=True):
                sizes[name] = max(sizes.get(name, 0.0), value)
        worst = max(sizes, key=lambda name: sizes[name])
        usual = float(np.median(list(sizes.values())))
        largest.append(
            f'{kind} {worst} ({sizes[worst]:.1f} times the expected, the median is {usual:.1f}'
        )
    return f'It is largest on {") and on ".join(largest)}).'


def _candidates(rounds: Sequence[Sequence[Candidate]]) -> str:
    parts = []
    for number, candidates in enumerate(rounds, start=1):
        ordered = sorted(candidates, key=lambda c: -(c.fitted_gain or c.gain))[:MOST_CANDIDATES]
        rows = [
            [
                candidate.term.label,
                str(candidate.parameters),
                f'{candidate.gain:.1f}',
                '' if candidate.fitted_gain is None else f'{candidate.fitted_gain:.1f}',
            ]
            for candidate in ordered
        ]
        head = ['candidate', 'parameters', 'held-out gain, score test', 'held-out gain, fitted']
        parts.append(
            f'<details{" open" if number == 1 else ""}><summary>Round {number}: '
            f'{len(candidates)} candidates, the best {len(ordered)}</summary>'
            f'{_table(head, rows)}</details>'
        )
    return (
        '<p>What each takes off the squared residual of blocks that its fit has not seen, in '
        'units of the misfit.</p>' + ''.join(parts)
    )


def _left_out(result: SessionDiagnosis) -> str:
    found = result.diagnosis
    rows = [
        [term.label, check.reason, f'{check.variation:.0%}', f'{check.remainder:.1%}']
        for term, check in found.refused
    ]
    text = ''
    if rows:
        text += '<h2>Refused</h2><p>These explained something, but may not be named.</p>'
        head = ['candidate', 'why', 'varies by', 'leaves where it acts']
        text += _table(head, rows)
    if found.search.removed:
        names = ', '.join(term.label for term in found.search.removed)
        text += f'<p>Explained away by others: {html.escape(names)}.</p>'
    return text


def _tools(state: State) -> list[Part]:
    return [part for part in state.parts if not part.view.is_reference]


def _rms(part: Part, axis: int) -> Array:
    good = part.whitener.weight > 0
    return np.asarray(
        np.sqrt((part.white**2 * good).sum(axis=axis) / np.maximum(good.sum(axis=axis), 1))
    )


def _image(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=110)
    plt.close(figure)
    data = base64.b64encode(buffer.getvalue()).decode('ascii')
    return f'<img alt="figure" src="data:image/png;base64,{data}">'


def _time_line(before: State, after: State) -> Figure:
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    for state, colour, label in ((before, BEFORE, 'before'), (after, AFTER, 'after')):
        for part in _tools(state):
            axes.plot(part.view.time, _rms(part, 1), '.', ms=3, color=colour, label=label)
    axes.axhline(1.0, color='0.6', lw=0.8)
    axes.set(xlabel='time, s', ylabel='residual / expected', yscale='log')
    _legend_once(axes)
    return figure


def _legend_once(axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    axes.legend(unique.values(), unique.keys())


def _maps(before: State, after: State) -> Figure:
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), layout='constrained', sharey=True)
    sizes = [np.concatenate([_rms(part, 1) for part in _tools(s)]) for s in (before, after)]
    top = max(float(np.percentile(sizes[0], 98)), 1.5)
    for panel, state, size, title in zip(
        panels, (before, after), sizes, ('before', 'after'), strict=True
    ):
        place = np.concatenate([part.view.position for part in _tools(state)])
        shown = panel.scatter(1e3 * place[:, 0], 1e3 * place[:, 1], c=size, s=8, vmin=0, vmax=top)
        panel.set(title=title, xlabel='x, mm', aspect='equal')
    panels[0].set_ylabel('y, mm')
    figure.colorbar(shown, ax=panels, label='residual / expected')
    return figure


def _bars(before: State, after: State) -> Figure:
    figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout='constrained')
    for offset, state, colour, label in (
        (-0.2, before, BEFORE, 'before'), (0.2, after, AFTER, 'after'),
    ):  # fmt: skip
        for panel, axis in zip(panels, ('channel', 'emitter'), strict=True):
            names, sizes = _by(state, axis)
            panel.bar(np.arange(len(names)) + offset, sizes, 0.4, color=colour, label=label)
            panel.set_xticks(np.arange(len(names)), names)
            panel.set_xlabel(axis)
    panels[0].set_ylabel('residual / expected')
    panels[0].legend()
    return figure


def _by(state: State, axis: str) -> tuple[list[str], Array]:
    """Return the names of all channels or emitters, and the residual of each."""
    names: list[str] = []
    sizes: list[float] = []
    squares: Array | None = None
    for part in _tools(state):
        sensors, emitters = part.view.flux.shape[1:]
        size = (_rms(part, 0) ** 2).reshape(2, sensors, emitters).mean(axis=0)
        if axis == 'channel':
            names += [str(c) for c in part.view.sensors.channel.tolist()]
            sizes += np.sqrt(size.mean(axis=1)).tolist()
        else:
            squares = size.mean(axis=0) if squares is None else squares + size.mean(axis=0)
            names = [str(k) for k in range(emitters)]
    if squares is not None:
        sizes = np.sqrt(squares / len(_tools(state))).tolist()
    return names, np.array(sizes)
