"""Shows the diagnosis as a self-contained page for readers who do not know the code."""

from collections.abc import Iterator, Sequence
from typing import Any

from anser_ros.cli.diagnosis_figures import bars, course, maps, strongest, time_line
from anser_ros.cli.diagnosis_words import (
    flux_unit,
    held_out_rows,
    paths,
    short_ones,
    value_text,
    verdict,
)
from anser_ros.cli.html_page import details, heading, page, paragraph, picture, table, top
from anser_ros.cli.populations import population_figure, population_table
from anser_ros.diagnosis.search import Candidate
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.diagnosis import SessionDiagnosis

MOST_CANDIDATES = 40
"""Most candidates of a round that the page lists, the best first; it says how many there were."""


def render(result: SessionDiagnosis, document: dict[str, Any], *, session: str, model: str) -> str:
    """Return the page of a diagnosis, and of the document that describes it, as HTML."""
    found = result.diagnosis
    return page(
        'Diagnosis',
        top('Diagnosis', verdict(document), session=session, model=model),
        heading(
            'Before and after',
            'Measured on every fifth stretch of time, which was used neither to choose nor to '
            "fit. Each frame's optical jitter, which moves all channels together, is taken out "
            'of the flux residual.',
        ),
        table(['', 'before', 'after'], held_out_rows(document)),
        effects_section(document),
        _paths(document, result),
        population_sections(found.model.effects),
        heading('Residuals over time', 'In the pictures 1 is what noise alone would give.'),
        picture(time_line(found.before, found.after)),
        heading('Residuals over the volume'),
        picture(maps(found.before, found.after)),
        heading('Residuals by channel and emitter'),
        picture(bars(found.before, found.after)),
        _structure(result),
        _candidates(found.search.rounds),
        _left_out(result),
    )


def effects_section(document: dict[str, Any]) -> Iterator[str]:
    """Show the effects as a table, or a paragraph where there are none."""
    factor, unit = flux_unit(document['held_out']['flux_rms_before_t'])
    yield heading('Effects')
    if not document['effects']:
        yield paragraph(
            'No effect is named: those that explained something differed from one part of the '
            'data to the next, or left too much where they act (see Refused, below). Nothing is '
            'corrected; a wrong correction would be worse than none.'
            if document['unexplained']['fraction'] > 0
            else 'None: the session passes every test, and nothing is corrected.'
        )
        return
    yield table(
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
        for key, path in paths(effect['parameters']):
            sigma = effect['uncertainty'].get(key)
            yield heading(f'{effect["name"]}: {key}', level=3)
            if 'position_m' in path:
                yield picture(course(path, sigma, result.diagnosis.after))
            columns = {**path, **({'1 sigma': sigma} if sigma is not None else {})}
            rows = [[value_text(v) for v in row] for row in zip(*columns.values(), strict=True)]
            yield details(f'{len(rows)} points', table(list(columns), rows))


def population_sections(records: Sequence[EffectRecord]) -> Iterator[str]:
    """Show how the sensors differ, as the model corrects it: what it had and what was found."""
    figure = population_figure(records)
    if figure is not None:
        yield heading(
            'Errors of all sensors',
            'The error of each sensor with one standard deviation, as the corrected model removes '
            'it; the grey band is the spread of all sensors.',
        )
        yield picture(figure)
        yield details('all sensors', table(*population_table(records)))


def _structure(result: SessionDiagnosis) -> Iterator[str]:
    found = result.diagnosis
    yield heading(
        'What stays unexplained',
        'Share of the residual power that follows each variable beyond chance. A trace is '
        'significant, but too small to matter.',
    )
    if found.unexplained > 0:
        yield paragraph(strongest(found.after))
    before = {test.variable: test.share for test in found.tests_before}
    yield table(
        ['residual against', 'share before', 'share after', 'probability in noise alone', 'left?'],
        [
            [
                test.variable,
                f'{before[test.variable]:.2%}',
                f'{test.share:.2%}',
                f'{test.probability:.2g}',
                'yes'
                if test.variable in found.depends_on
                else 'trace'
                if test.significant
                else 'no',
            ]
            for test in found.tests_after
            if test.variable in before
        ],
    )


def _candidates(rounds: Sequence[Sequence[Candidate]]) -> Iterator[str]:
    yield heading(
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
        yield details(words, table(head, rows), is_open=count == 1)


def _left_out(result: SessionDiagnosis) -> Iterator[str]:
    found = result.diagnosis
    if found.refused:
        yield heading('Refused', 'These explained something, but not reliably enough to be named.')
        yield table(
            ['candidate', 'why', 'varies by', 'residual where it acts'],
            [
                [term.label, check.reason, f'{check.variation:.0%}', f'{check.remainder:.1%}']
                for term, check in found.refused
            ],
        )
    if found.search.removed:
        names = ', '.join(term.label for term in found.search.removed)
        yield paragraph(f'Explained away by others: {names}.')
