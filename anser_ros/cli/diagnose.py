"""Find what a model leaves unexplained on a session, name the effect, correct it.

The report is a self-contained page for readers who do not know the code; in its figures 1 is what
noise alone would give.
"""

import argparse
import importlib
from collections.abc import Iterator, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from anser_ros.arrays import Array
from anser_ros.cli import output, sessions
from anser_ros.cli import page as html
from anser_ros.cli.calibrate import population_figure, population_table
from anser_ros.cli.diagnosis_words import flux_unit, held_out_rows, short_ones, value_text, verdict
from anser_ros.diagnosis.problem import State, tool_parts
from anser_ros.diagnosis.search import Candidate
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.diagnosis import SessionDiagnosis, diagnose_session, other_way, to_document
from anser_ros.sessions.starting_model import save_model
from anser_ros.settings import SECTIONS, VALUES

USED_ALONE = {*SECTIONS['tools'], *(n for n in SECTIONS['accuracy'] if 'reference' not in n)}
"""Values that may be stated where no baseline is given, and so no references are used."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        'example: anser diagnose bags/moving.mcap --model config/demo_model.yaml --out result/'
    )
    sessions.add_session_options(parser, 'diagnose', 'diagnosis.json')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Diagnose the session of the arguments into its folder; several one after the other."""
    return sessions.on_each('diagnose', _one, args, tell)


def _one(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Diagnose one session of fluxes."""
    idle = () if args.baseline else (n for n in VALUES if n not in USED_ALONE)
    session, model, baseline, notes = sessions.given(args, idle, '--baseline')
    names = {'session': args.session, 'model': args.model}
    if way := other_way(session, baseline):
        other = way.diagnose(session, model, tell)
        tell('writing the report')
        document, corrected = way.to_document(other), other.model
        report = importlib.import_module(way.REPORT).render(other, document, **names)
    else:
        found = diagnose_session(session, model, baseline, tell)
        tell('writing the report')
        document, corrected = to_document(found), found.diagnosis.model
        report = render(found, document, **names)
    save_model(args.out / 'model.yaml', corrected)
    written = output.write_files(args.out, {'report.html': report, 'diagnosis.json': document})
    return output.Result(
        document,
        notes,
        (
            output.terminal_table(['held out', 'before', 'after'], held_out_rows(document)),
            verdict(document),
        ),
        (*written, args.out / 'model.yaml'),
    )


def strongest(state: State) -> str:
    """State in words on which channel and emitter the residual is largest."""
    largest = []
    for kind in ('channel', 'emitter'):
        names, sizes = _by(state, kind)
        worst = int(np.argmax(sizes))
        largest.append(
            f'{kind} {names[worst]} ({sizes[worst]:.1f} times the expected, the median is '
            f'{np.median(sizes):.1f}'
        )
    return f'It is largest on {") and on ".join(largest)}).'


def time_line(before: State, after: State) -> Figure:
    """Draw the residual of every frame over time, without and with the effects."""
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    # Larger below: where nothing is corrected, both lie on each other.
    for state, colour, label, size in (
        (before, html.BEFORE, 'before', 6), (after, html.AFTER, 'after', 3),
    ):  # fmt: skip
        for part in tool_parts(state):
            axes.plot(part.view.time, part.rms(1), '.', ms=size, color=colour, label=label)
    axes.axhline(1.0, color='0.6', lw=0.8)
    axes.set(xlabel='time, s', ylabel='residual / expected')
    sizes = np.concatenate([part.rms(1) for one in (before, after) for part in tool_parts(one)])
    if sizes.max() > html.WIDE * sizes.min():
        axes.set(yscale='log')
        html.spell_out(axes.yaxis)
    html.legend_beside(figure)
    return figure


def maps(before: State, after: State) -> Figure:
    """Draw the residual of every frame where the tool was, seen from above."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), layout='constrained', sharey=True)
    sizes = [np.concatenate([part.rms(1) for part in tool_parts(s)]) for s in (before, after)]
    top = max(float(np.percentile(sizes[0], 98)), 1.5)
    for panel, state, size, title in zip(
        panels, (before, after), sizes, ('before', 'after'), strict=True
    ):
        place = np.concatenate([part.view.position for part in tool_parts(state)])
        shown = panel.scatter(1e3 * place[:, 0], 1e3 * place[:, 1], c=size, s=8, vmin=0, vmax=top)
        panel.set(title=title, xlabel='x, mm', aspect='equal')
    panels[0].set_ylabel('y, mm')
    figure.colorbar(shown, ax=panels, label='residual / expected')
    return figure


def course(path: dict[str, Any], sigma: Any, state: State) -> Figure:
    """Draw where something was, from above and over time, with the tool's places and the board.

    ``path`` has ``time_s`` (P,) and ``position_m`` (P, 3) in fg; ``sigma``, m, is (P, 3), (P,) or
    None; ``state`` holds where the tool was.
    """
    figure, (above, over) = plt.subplots(1, 2, figsize=(9, 3.6), layout='constrained')
    time, place = np.asarray(path['time_s']), 1e3 * np.asarray(path['position_m'])
    tool = 1e3 * np.concatenate([part.view.position for part in tool_parts(state)])
    above.plot(tool[:, 0], tool[:, 1], '.', ms=3, color='0.8', label='tool')
    above.plot(place[:, 0], place[:, 1], '.-', color=html.BEFORE, label='path')
    above.plot(*place[0, :2], 'o', ms=9, mfc='none', color=html.BEFORE, label='start')
    above.set(xlabel='x, mm', ylabel='y, mm', aspect='equal')
    spread = None if sigma is None else 1e3 * np.asarray(sigma).reshape(len(time), -1)
    for axis, (name, mark) in enumerate((('x', ':'), ('y', '--'), ('z', '-'))):
        over.plot(time, place[:, axis], mark, color=html.BEFORE, label=name)
        if spread is not None:
            wide = spread[:, min(axis, spread.shape[1] - 1)]
            low, high = place[:, axis] - wide, place[:, axis] + wide
            over.fill_between(time, low, high, color=html.BEFORE, alpha=0.12, lw=0)
    over.set(xlabel='time, s', ylabel='position, mm')
    for panel in (above, over):
        html.legend_under(panel)
        panel.grid(alpha=0.3)
    return figure


def bars(before: State, after: State) -> Figure:
    """Draw the residual of every channel and of every emitter."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout='constrained')
    for offset, state, colour, label in (
        (-0.2, before, html.BEFORE, 'before'), (0.2, after, html.AFTER, 'after'),
    ):  # fmt: skip
        for panel, axis in zip(panels, ('channel', 'emitter'), strict=True):
            names, sizes = _by(state, axis)
            panel.bar(np.arange(len(names)) + offset, sizes, 0.4, color=colour, label=label)
            panel.set_xticks(np.arange(len(names)), names)
            panel.set_xlabel(axis)
    panels[0].set_ylabel('residual / expected')
    html.legend_beside(figure)
    return figure


def _by(state: State, axis: str) -> tuple[list[str], Array]:
    """Return the names of all channels or emitters, and the residual of each."""
    power = {c: own for part in tool_parts(state) for c, own in part.power().items()}
    sizes = np.array(list(power.values())).mean(axis=1 if axis == 'channel' else 0)
    names = list(power) if axis == 'channel' else list(range(len(sizes)))
    return [str(name) for name in names], np.sqrt(sizes)


MOST_CANDIDATES = 40
"""Most candidates of a round that the page lists, the best first; it says how many there were."""


def render(result: SessionDiagnosis, document: dict[str, Any], *, session: str, model: str) -> str:
    """Return the page of a diagnosis, and of the document that describes it, as HTML."""
    found = result.diagnosis
    return html.page(
        'Diagnosis',
        html.top('Diagnosis', verdict(document), session=session, model=model),
        html.heading(
            'Before and after',
            'Measured on every fifth stretch of time, which was used neither to choose nor to '
            "fit. Each frame's optical jitter, which moves all channels together, is taken out "
            'of the flux residual.',
        ),
        html.table(['', 'before', 'after'], held_out_rows(document)),
        effects_section(document),
        _paths(document, result),
        population_sections(found.model.effects),
        html.heading('Residuals over time', 'In the pictures 1 is what noise alone would give.'),
        html.picture(time_line(found.before, found.after)),
        html.heading('Residuals over the volume'),
        html.picture(maps(found.before, found.after)),
        html.heading('Residuals by channel and emitter'),
        html.picture(bars(found.before, found.after)),
        _structure(result),
        _candidates(found.search.rounds),
        _left_out(result),
    )


def effects_section(document: dict[str, Any]) -> Iterator[str]:
    """Show the effects as a table, or a paragraph where there are none."""
    factor, unit = flux_unit(document['held_out']['flux_rms_before_t'])
    yield html.heading('Effects')
    if not document['effects']:
        yield html.paragraph(
            'No effect is named: those that explained something differed from one part of the '
            'data to the next, or left too much where they act (see Refused, below). Nothing is '
            'corrected; a wrong correction would be worse than none.'
            if document['unexplained']['fraction'] > 0
            else 'None: the session passes every test, and nothing is corrected.'
        )
        return
    yield html.table(
        ['effect', 'what it is', 'parameters', '1 sigma', f'residual without it, {unit}',
         'explains nearly as much', 'online'],
        [
            [
                effect['name'],
                str(effect['evidence'].get('summary', '')),
                '\n'.join(f'{k} = {value_text(v)}' for k, v in short_ones(effect['parameters'])),
                '\n'.join(f'{k} ± {value_text(v)}' for k, v in short_ones(effect['uncertainty'])),
                f'{factor * effect["flux_rms_without_t"]:.4g}',
                ', '.join(effect['evidence'].get('rivals') or []) or 'none',
                str(effect['evidence'].get('remedy', '')),
            ]
            for effect in document['effects']
        ],
    )  # fmt: skip


def _paths(document: dict[str, Any], result: SessionDiagnosis) -> Iterator[str]:
    """Every course that an effect was found to have: a picture, and its numbers on demand."""
    for effect in document['effects']:
        for key, path in effect['parameters'].items():
            if not isinstance(path, dict) or 'time_s' not in path:
                continue
            sigma = effect['uncertainty'].get(key)
            yield html.heading(f'{effect["name"]}: {key}', level=3)
            if 'position_m' in path:
                yield html.picture(course(path, sigma, result.diagnosis.after))
            columns = {**path, **({'1 sigma': sigma} if sigma is not None else {})}
            rows = [[value_text(v) for v in row] for row in zip(*columns.values(), strict=True)]
            yield html.details(f'{len(rows)} points', html.table(list(columns), rows))


def population_sections(records: Sequence[EffectRecord]) -> Iterator[str]:
    """Show how the sensors differ, as the model corrects it: what it had and what was found."""
    figure = population_figure(records)
    if figure is not None:
        yield html.heading(
            'Errors of all sensors',
            'The error of each sensor with one standard deviation, as the corrected model removes '
            'it; the grey band is the spread of all sensors.',
        )
        yield html.picture(figure)
        yield html.details('all sensors', html.table(*population_table(records)))


def _structure(result: SessionDiagnosis) -> Iterator[str]:
    found = result.diagnosis
    yield html.heading(
        'What stays unexplained',
        'Share of the residual power that follows each variable beyond chance. A trace is '
        'significant, but too small to matter.',
    )
    if found.unexplained > 0:
        yield html.paragraph(strongest(found.after))
    before = {test.variable: test.share for test in found.tests_before}
    rows = []
    for test in (test for test in found.tests_after if test.variable in before):
        left = 'trace' if test.significant else 'no'
        left = 'yes' if test.variable in found.depends_on else left
        shares = f'{before[test.variable]:.2%}', f'{test.share:.2%}'
        rows.append([test.variable, *shares, f'{test.probability:.2g}', left])
    yield html.table(
        ['residual against', 'share before', 'share after', 'probability in noise alone', 'left?'],
        rows,
    )


def _candidates(rounds: Sequence[Sequence[Candidate]]) -> Iterator[str]:
    yield html.heading(
        'Every candidate',
        'How much each lowers the squared residual of blocks that its fit did not use, in units '
        'of the misfit.',
    )
    head = ['candidate', 'parameters', 'held-out gain, score test', 'held-out gain, fitted']
    for count, candidates in enumerate(rounds, start=1):
        ordered = sorted(candidates, key=lambda c: -(c.fitted_gain or c.gain))[:MOST_CANDIDATES]
        rows = [
            [
                one.term.label,
                str(one.parameters),
                f'{one.gain:.1f}',
                '' if one.fitted_gain is None else f'{one.fitted_gain:.1f}',
            ]
            for one in ordered
        ]
        words = f'Round {count}: {len(candidates)} candidates, the best {len(ordered)}'
        yield html.details(words, html.table(head, rows), is_open=count == 1)


def _left_out(result: SessionDiagnosis) -> Iterator[str]:
    found = result.diagnosis
    if found.refused:
        yield html.heading(
            'Refused', 'These explained something, but not reliably enough to be named.'
        )
        yield html.table(
            ['candidate', 'why', 'varies by', 'residual where it acts'],
            [
                [term.label, check.reason, f'{check.variation:.0%}', f'{check.remainder:.1%}']
                for term, check in found.refused
            ],
        )
    if found.search.removed:
        names = ', '.join(term.label for term in found.search.removed)
        yield html.paragraph(f'Explained away by others: {names}.')
