"""Puts what a diagnosis found into words for people."""

from collections import Counter
from typing import Any

from anser_ros.cli.output import number
from anser_ros.physics.constants import DEGREES

LONGEST = 9
"""Most numbers of a parameter that are shown in a line: those of a 3 x 3 matrix. Longer ones stand
in diagnosis.json, paths in a table of the report too."""
MOST_CHARACTERS = 400
"""Characters that a verdict is kept below: about five lines of a terminal."""
FLUX_UNITS = ((1e-8, 1e12, 'pT'), (1e-5, 1e9, 'nT'), (1e-2, 1e6, 'uT'), (1e9, 1e3, 'mT'))
"""Up to which size, T, fluxes are shown with which factor in which unit."""


def flux_unit(size_t: float) -> tuple[float, str]:
    """Return factor and unit in which fluxes of a size, T, are shown."""
    return next((factor, unit) for most, factor, unit in FLUX_UNITS if size_t < most)


def held_out_rows(document: dict[str, Any]) -> list[list[str]]:
    """Return the errors on held-out data, before and after, and the noise floor, as a table."""
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
            rows.append([label, *(number(value, scale, '.4g') for value in pair)])
    floor = number(held['flux_rms_floor_t'], factor, '.4g')
    return [*rows, [f'noise floor of the flux, {shown} rms', '', floor]]


def verdict(document: dict[str, Any]) -> str:
    """State in one short paragraph what was found and what stays unexplained.

    Effects are named with their parameters if there is room, otherwise without.
    """
    effects = document['effects']
    counts = Counter(str(effect['name']) for effect in effects)
    short = [name if n == 1 else f'{name} ({n} times)' for name, n in counts.items()]
    for names in (', '.join(map(_named, effects)), ', '.join(short)):
        text = _paragraph(document, names)
        if len(text) < MOST_CHARACTERS:
            return text
    return _paragraph(document, 'see the table of effects')


def _paragraph(document: dict[str, Any], names: str) -> str:
    held, effects = document['held_out'], document['effects']
    before, after = held['flux_rms_before_t'], held['flux_rms_after_t']
    factor, unit = flux_unit(before)
    if effects:
        text = (
            f'The model lacks {len(effects)} effect{"s" if len(effects) > 1 else ""}: {names}. '
            f'With {"them" if len(effects) > 1 else "it"} the residual on held-out data falls '
            f'from {_number(factor * before)} to {_number(factor * after)} {unit}'
        )
        pair = held['position_rmse_before_m'], held['position_rmse_after_m']
        if None not in pair:
            text += f', and the position error from {1e3 * pair[0]:.3g} to {1e3 * pair[1]:.3g} mm'
        text += '.'
    else:
        floor = _number(factor * held['flux_rms_floor_t'])
        text = 'No known effect explains the residual of this session: '
        if document['unexplained']['fraction'] == 0:
            text = 'The model explains this session, and no effect is needed: '
        text += (
            f'the residual on held-out data is {_number(factor * after)} {unit}, '
            f'the noise {floor} {unit}.'
        )
    rest = document['unexplained']
    if rest['fraction'] > 0:
        on = ', '.join(rest['depends_on']) or 'none of the variables examined'
        share = f'{rest["fraction"]:.0%}' if rest['fraction'] >= 0.01 else 'Less than 1%'
        left = factor * max(after**2 - held['flux_rms_floor_t'] ** 2, 0.0) ** 0.5
        rest_text = f'{left:.2g}' if left < 100.0 else f'{left:.0f}'
        text += (
            f' {share} of the power above the noise stays unexplained, {rest_text} {unit} rms; '
            f'it depends on {on}.'
        )
    else:
        text += ' Nothing above the noise stays unexplained.'
    return text


def _number(value: float) -> str:
    """A size with at least three digits, and no decimals from a hundred on."""
    return f'{value:.0f}' if value >= 100.0 else f'{value:.3g}'


def _named(effect: dict[str, Any]) -> str:
    shown = ', '.join(
        f'{key} {value_text(value)}' for key, value in short_ones(effect['parameters'])
    )
    return f'{effect["name"]} ({shown})' if shown else str(effect['name'])


def short_ones(parameters: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return parameters that fit a line, by name; long lists and mappings are left out."""
    return [(key, value) for key, value in parameters.items() if _size(value) <= LONGEST]


def _size(value: Any) -> int:
    if isinstance(value, dict):
        return sum(_size(item) for item in value.values())
    return sum(_size(item) for item in value) if isinstance(value, list) else 1


def value_text(value: Any) -> str:
    """Return a parameter's value as text with four digits."""
    if isinstance(value, list):
        return '[' + ', '.join(value_text(item) for item in value) + ']'
    return f'{value:.4g}' if isinstance(value, float) else str(value)
