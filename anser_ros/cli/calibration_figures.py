"""Shows a calibration: what was tried for the field, and how the sensors differ."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.result import Calibration
from anser_ros.cli.diagnosis_words import flux_unit
from anser_ros.effects.effect import effect_named
from anser_ros.field.model import EffectRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

SHOWN_UNITS = {'1': (100.0, '%'), 'rad': (1e3, 'mrad'), 'm': (1e3, 'mm'), 'T': (1e9, 'nT')}
"""Factor and unit in which values of each SI unit are shown."""
MOST_TICKS = 9
"""Channels that are named on the axis of a picture; of more, some at even steps."""
MOST_PARTS = 3
"""Values of a channel that a table has columns for; of more, their root mean square is shown."""


def populations(records: Sequence[EffectRecord]) -> list[EffectRecord]:
    """Return the records that hold a value and its uncertainty for every channel."""
    return [r for r in records if {'channels', 'values', 'uncertainty'} <= r.parameters.keys()]


def population_table(
    records: Sequence[EffectRecord],
) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows, one per channel, of the table of all populations.

    Of gains, the difference from one is shown.
    """
    found = populations(records)
    channels = sorted({int(c) for record in found for c in record.parameters['channels']})
    head, columns = ['channel'], [[str(channel) for channel in channels]]
    for record in found:
        names, unit, values, sigma = _shown(record)
        rows = {int(c): i for i, c in enumerate(record.parameters['channels'])}
        for part, name in enumerate(names):
            head.append(f'{record.name}{f" {name}" if name else ""}, {unit}')
            pairs = zip(values[:, part], sigma[:, part], strict=True)
            cells = [f'{value:.4f} ± {spread:.4f}' for value, spread in pairs]
            columns.append([cells[rows[c]] if c in rows else '' for c in channels])
    return head, [list(row) for row in zip(*columns, strict=True)]


def population_figure(records: Sequence[EffectRecord]) -> 'Figure | None':
    """Draw each channel's values with one sigma, and the population's width behind them.

    Returns None where no record is a population.
    """
    found = populations(records)
    if not found:
        return None
    from matplotlib import pyplot as plt

    from anser_ros.cli.page import legend_under

    width = 4 * len(found)
    figure, panels = plt.subplots(
        1, len(found), figsize=(width, 3.5), squeeze=False, layout='constrained'
    )
    for panel, record in zip(panels[0], found, strict=True):
        names, unit, values, sigma = _shown(record)
        factor = SHOWN_UNITS[effect_named(record.name).units['values']][0]
        spread = factor * float(record.parameters['spread'])
        panel.axhspan(-spread, spread, color='0.9', label='spread')
        places = np.arange(len(values))
        for part, name in enumerate(names):
            if not (values[:, part].any() or sigma[:, part].any()):
                continue  # constant fields have no quadrature
            at = places + 0.15 * (part - (len(names) - 1) / 2.0)
            panel.errorbar(at, values[:, part], sigma[:, part], fmt='.', capsize=2, label=name)
        named = places[:: -(-len(places) // MOST_TICKS)]
        panel.set_xticks(named, [str(record.parameters['channels'][k]) for k in named])
        panel.set(title=f'{record.name}: {spread:.3g} {unit}', xlabel='channel', ylabel=unit)
        panel.grid(alpha=0.3)
        legend_under(panel, 0.17, 7)
    return figure


def _shown(record: EffectRecord) -> tuple[tuple[str, ...], str, Array, Array]:
    """Return names and unit of what is shown, and values and sigma (C, P) in that unit."""
    effect = effect_named(record.name)
    factor, unit = SHOWN_UNITS[effect.units['values']]
    values = np.array(record.parameters['values'], dtype=np.float64)
    # What all faultless channels have, one for a gain, is no error.
    values = factor * (values - np.median(values, axis=0).round())
    sigma = factor * np.array(record.parameters['uncertainty'], dtype=np.float64)
    if values.shape[1] <= MOST_PARTS:
        return effect.parts or ('',) * values.shape[1], unit, values, sigma
    mean = [np.sqrt(np.mean(part**2, axis=1, keepdims=True)) for part in (values, sigma)]
    return ('rms',), unit, mean[0], mean[1]


def choice_figure(calibration: Calibration) -> 'Figure | None':
    """Draw held-out errors by the number of dipoles, and by damping for the six best layouts.

    Returns None where no layouts were compared.
    """
    if not calibration.candidates:
        return None
    from matplotlib import pyplot as plt

    from anser_ros.cli.page import legend_under

    layout = replace(calibration.layout, local=False)
    picked = next(one for one in calibration.candidates if one.layout == layout)
    factor, unit = flux_unit(picked.score)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5.4), layout='constrained')
    for mark, name, moved in (('o', 'placed', False), ('^', 'positions optimised', True)):
        found = [c for c in calibration.candidates if bool(c.layout.moved) == moved]
        scores = [factor * c.score for c in found]
        left.plot([len(c.dipoles) for c in found], scores, mark, label=name)
    left.plot(len(picked.dipoles), factor * picked.score, 's', ms=12, mfc='none', label='chosen')
    left.set(xlabel='dipoles', ylabel=f'predictive error of held-out blocks, {unit}', yscale='log')
    for candidate in sorted(calibration.candidates, key=lambda c: c.score)[:6]:
        damping, score = zip(*candidate.curve, strict=True)
        right.plot(damping, [factor * s for s in score], '.-', label=candidate.layout.describe())
    right.set(xlabel='damping', xscale='log', yscale='log')
    for panel in (left, right):
        panel.grid(alpha=0.3)
        legend_under(panel, 0.14, 7, columns=1)
    figure.suptitle('Choice by held-out error, pose marginalised', fontsize=10)
    return figure
