"""Shows the diagnosis as a self-contained page for readers who do not know the code."""

import html
from collections.abc import Iterator, Sequence
from typing import Any

from anser_ros.cli.diagnosis_figures import bars, course, maps, strongest, time_line
from anser_ros.cli.diagnosis_words import flux_unit, paths, short_ones, value_text, verdict
from anser_ros.cli.html_page import page, table
from anser_ros.cli.populations import population_figure, population_table
from anser_ros.diagnosis.search import Candidate
from anser_ros.field.model import EffectRecord
from anser_ros.physics.constants import DEGREES
from anser_ros.pictures import image
from anser_ros.sessions.diagnosis import SessionDiagnosis

MOST_CANDIDATES = 40
"""Most candidates of a round that the page lists, the best first; it says how many there were."""


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
        page_head(document, session, model),
        '<h2>Before and after</h2><p>Measured on every fifth stretch of time, which was used '
        'neither to choose nor to fit. Each frame&#39;s optical jitter, which moves all '
        'channels together, is taken out of the flux residual.</p>',
        held_out_table(document),
        '<h2>Effects</h2>',
        effects_table(document),
        *_paths(document, result),
        *population_sections(result.diagnosis.model.effects),
        '<h2>Residuals over time</h2><p>In the pictures 1 is what noise alone would give.</p>',
        image(time_line(found.before, found.after)),
        '<h2>Residuals over the volume</h2>',
        image(maps(found.before, found.after)),
        '<h2>Residuals by channel and emitter</h2>',
        image(bars(found.before, found.after)),
        '<h2>What stays unexplained</h2>',
        _structure(result),
        '<h2>Every candidate</h2>',
        _candidates(found.search.rounds),
        _left_out(result),
    ]
    return page('Diagnosis', sections)


def page_head(document: dict[str, Any], session: str, model: str) -> str:
    """Return the heading of a diagnosis' page: what was diagnosed, and the verdict."""
    return (
        f'<h1>Diagnosis</h1><p class="note">session <code>{html.escape(session)}</code>, '
        f'model <code>{html.escape(model)}</code></p>'
        f'<p class="verdict">{html.escape(verdict(document))}</p>'
    )


def held_out_table(document: dict[str, Any]) -> str:
    """Return the errors on held-out data before and after as a table."""
    held = document['held_out']
    factor, shown = flux_unit(held['flux_rms_before_t'])
    rows = []
    for label, key, unit, scale in (
        (f'flux residual, {shown} rms', 'flux_rms', 't', factor),
        ('position RMSE of the coils, mm', 'position_rmse', 'm', 1e3),
        ('orientation RMSE of the coils, deg', 'orientation_rmse', 'rad', DEGREES),
    ):
        pair = [held[f'{key}_{when}_{unit}'] for when in ('before', 'after')]
        if pair != [None, None] or key == 'flux_rms':
            rows.append([label, *('-' if v is None else f'{scale * v:.4g}' for v in pair)])
    floor = f'{factor * held["flux_rms_floor_t"]:.4g}'
    rows.append([f'noise floor of the flux, {shown} rms', '', floor])
    return table(['', 'before', 'after'], rows)


def effects_table(document: dict[str, Any]) -> str:
    """Return the effects as a table, or a paragraph where there are none."""
    factor, unit = flux_unit(document['held_out']['flux_rms_before_t'])
    if not document['effects']:
        if document['unexplained']['fraction'] > 0:
            return (
                '<p>No effect is named: those that explained something differed from one part '
                'of the data to the next, or left too much where they act (see Refused, below). '
                'Nothing is corrected; a wrong correction would be worse than none.</p>'
            )
        return '<p>None: the session passes every test, and nothing is corrected.</p>'
    rows = []
    for effect in document['effects']:
        values = '\n'.join(f'{k} = {value_text(v)}' for k, v in short_ones(effect['parameters']))
        sigmas = '\n'.join(f'{k} ± {value_text(v)}' for k, v in short_ones(effect['uncertainty']))
        evidence = effect['evidence']
        rivals = ', '.join(evidence.get('rivals') or []) or 'none'
        rows.append(
            [
                effect['name'],
                str(evidence.get('summary', '')),
                values,
                sigmas,
                f'{factor * effect["flux_rms_without_t"]:.4g}',
                rivals,
                str(evidence.get('remedy', '')),
            ]
        )
    head = ['effect', 'what it is', 'parameters', '1 sigma', f'residual without it, {unit}',
            'explains nearly as much', 'online']  # fmt: skip
    return table(head, rows).replace('\n', '<br>')


def _paths(document: dict[str, Any], result: SessionDiagnosis) -> Iterator[str]:
    """Every course that an effect was found to have: a picture, and its numbers on demand."""
    for effect in document['effects']:
        for key, path in paths(effect['parameters']):
            sigma = effect['uncertainty'].get(key)
            title = f'{effect["name"]}: {key}'
            yield f'<h3>{html.escape(title)}</h3>'
            if 'position_m' in path:
                yield image(course(path, sigma, result.diagnosis.after))
            columns = {**path, **({'1 sigma': sigma} if sigma is not None else {})}
            rows = [
                [value_text(cell) for cell in row] for row in zip(*columns.values(), strict=True)
            ]
            yield (
                f'<details><summary>{len(rows)} points</summary>'
                f'{table(list(columns), rows)}</details>'
            )


def population_sections(records: Sequence[EffectRecord]) -> Iterator[str]:
    """Show how the sensors differ, as the model corrects it: what it had and what was found."""
    figure = population_figure(records)
    if figure is not None:
        yield '<h2>Errors of all sensors</h2><p>The error of each sensor with one standard '
        yield 'deviation, as the corrected model removes it; the grey band is the spread of all '
        yield 'sensors.</p>'
        yield image(figure)
        yield f'<details><summary>all sensors</summary>{table(*population_table(records))}'
        yield '</details>'


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
    head = [
        'residual against',
        'share before',
        'share after',
        'probability in noise alone',
        'left?',
    ]
    text = '<p>Share of the residual power that follows each variable beyond chance. A trace is '
    text += 'significant, but too small to matter.</p>'
    if found.unexplained > 0:
        text += f'<p>{html.escape(strongest(found.after))}</p>'
    return text + table(head, rows)


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
            f'{table(head, rows)}</details>'
        )
    return (
        '<p>How much each lowers the squared residual of blocks that its fit did not use, in '
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
        text += (
            '<h2>Refused</h2><p>These explained something, but not reliably enough to be '
            'named.</p>'
        )
        head = ['candidate', 'why', 'varies by', 'residual where it acts']
        text += table(head, rows)
    if found.search.removed:
        names = ', '.join(term.label for term in found.search.removed)
        text += f'<p>Explained away by others: {html.escape(names)}.</p>'
    return text
