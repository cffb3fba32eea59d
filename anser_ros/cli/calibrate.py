"""Fits a field model to recorded sessions, and shows what was tried and how the sensors differ."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from anser_ros.arrays import Array
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.result import Calibration, to_document
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.cli import output
from anser_ros.cli.diagnosis_words import flux_unit, short_ones, value_text
from anser_ros.cli.sessions import names_of
from anser_ros.effects.effect import effect_named
from anser_ros.errors import FitError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.constants import DEGREES
from anser_ros.sessions.calibration import calibrate_sessions, check_same_board, named_kinds
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import save_model

LONG = ('values', 'uncertainty', 'axes')
"""Parameters of a population that are tables, which are shown by themselves."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = 'example: anser calibrate bags/scan.mcap --out model.yaml --report report/'
    parser.add_argument('sessions', nargs='+', metavar='SESSION', help='bags to learn from')
    words = 'model file to write; its folder is made if missing'
    parser.add_argument('--out', required=True, type=Path, help=words)
    words = 'folder for calibration.json and choice.png, made if missing'
    parser.add_argument('--report', type=Path, help=words)
    output.add_json(parser, 'calibration.json on stdout')
    words = "write the model even when its held-out error is worse than the nominal model's"
    parser.add_argument('--force', action='store_true', help=words)
    words = 'use a layer of N x N z-dipoles on the board; chosen by held-out error by default'
    parser.add_argument('--dipoles', type=_layer, metavar='NxN', help=words)
    parser.add_argument(
        '--estimate', type=_kinds, default=KINDS, metavar='LIST',
        help='errors of sensors and clock to estimate together with the field, where the scan '
        f'supports them; "none" trusts the setup for all; by default {",".join(KINDS)}; '
        f'{",".join(named_kinds())} only when named',
    )  # fmt: skip
    output.add_stated_values(parser, 'accuracy')


def _layer(text: str) -> Layout:
    first, _, second = text.partition('x')
    if not first.isdigit() or second not in ('', first) or not 1 <= int(first) <= 64:
        raise argparse.ArgumentTypeError(f'must be NxN with N in 1..64, got {text!r}')
    return Layout('layer', int(first), 1.0, 0.0)


def _kinds(text: str) -> tuple[str, ...]:
    if text == 'none':
        return ()
    kinds = tuple(part for part in text.split(',') if part)
    known = (*KINDS, *named_kinds())
    unknown = [kind for kind in kinds if kind not in known]
    if unknown or not kinds:
        raise argparse.ArgumentTypeError(f'must be among {",".join(known)}, got {text!r}')
    return kinds


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Calibrate with the sessions of the arguments, into their files.

    Raises `FitError` when the nominal model is better, and that is not forced.
    """
    stated = output.stated_values(args)
    names_of(args.sessions)
    options = Options(layout=args.dipoles, estimate=args.estimate)
    sessions = [load_session(path).with_stated(stated) for path in args.sessions]
    check_same_board(sessions)
    output.check_file(args.out)
    output.make_folder(args.report)
    lost = output.loss_notes(*sessions)
    try:
        calibration = calibrate_sessions(sessions, options, tell)
    except FitError as error:
        lost = output.loss_notes(*sessions, said=str(error))
        raise FitError('; '.join((str(error), *lost))) from error
    document = to_document(calibration)
    if args.report is not None:
        figures = {
            'choice.png': choice_figure(calibration),
            'populations.png': population_figure(calibration.scan.corrections),
        }
        output.write_files(args.report, {'calibration.json': document, **figures})
    if not calibration.better_than_nominal and not args.force:
        raise FitError(
            f'no model written: its held-out error {document["heldout_flux_rmse_t"]:.3g} T is '
            f"worse than the nominal model's {calibration.nominal_rmse_t:.3g} T; "
            '--force writes it'
        )
    save_model(args.out, calibration.model)
    return output.Result(
        document,
        (*lost, *document['unobservable'], *document['contradictions']),
        (_table(calibration, document), *_populations(calibration)),
        tuple(filter(None, (args.out, args.report))),
    )


def _table(calibration: Calibration, document: dict[str, Any]) -> Table:
    rows = [
        ('readings per emitter', f'{document["n_measurements"]}'),
        ('dipoles', calibration.layout.describe()),
        *([('damping', f'{calibration.damping:g}')] if calibration.damping else []),
        ('residual, T rms', f'{document["flux_rmse_t"]:.4g}'),
        ('held out, T rms', f'{document["heldout_flux_rmse_t"]:.4g}'),
        ('range of the readings, T', f'{calibration.residuals.span_t:.3g}'),
        ('held out, % of the range', f'{document["heldout_n_rmse_percent"]:.4f}'),
        ("the field model's own error, T", f'{calibration.held_out.flux_error_t:.3g}'),
        ('noise, T a component', f'{calibration.fit.noise_t:.3g}'),
    ]
    if optical := document['optical_noise']:
        position, rotation = 1e3 * optical['position_m'], DEGREES * optical['rotation_rad']
        jitter = f'{position:.3f} mm, {rotation:.4f} deg'
        what = 'typed places, error' if document.get('plate') else 'optical jitter'
        rows.append((f'{what} a component, at most', jitter))
    rows += [(effect.name, _parameters(effect)) for effect in calibration.model.effects]
    for effect in calibration.scan.reported_effects:
        rows.append((f'{effect.name}, not in the model', _parameters(effect)))
    of_emitters = zip(calibration.model.emitters, calibration.emitters, strict=False)
    rows += [(name, own['words']) for name, own in of_emitters]
    return output.terminal_table(['', ''], rows, title='calibration', show_header=False)


def _parameters(effect: EffectRecord) -> str:
    found = {k: v for k, v in effect.parameters.items() if k not in LONG}
    return ', '.join(f'{k} {value_text(v)}' for k, v in short_ones(found))


def _populations(calibration: Calibration) -> Iterator[Table]:
    """A table of each kind in which the sensors differ, as far as the scan says that they do."""
    for record in populations(calibration.scan.corrections):
        head, rows = population_table([record])
        names = [name.removeprefix(f'{record.name} ') for name in head]
        yield output.terminal_table(names, rows, title=record.name)


SHOWN_UNITS = {
    '1': (100.0, '%'),
    'rad': (1e3, 'mrad'),
    'm': (1e3, 'mm'),
    'T': (1e9, 'nT'),
    's': (1e6, 'us'),
}
"""Factor and unit in which values of each SI unit are shown."""
MOST_TICKS = 9
"""Channels that are named on the axis of a picture; of more, some at even steps."""
MOST_PARTS = 3
"""Values of a channel that a table has columns for; of more, their root mean square is shown."""


def populations(records: Sequence[EffectRecord]) -> list[EffectRecord]:
    """Return the records that hold a value and its uncertainty for every channel."""
    return [r for r in records if {'channels', 'values', 'uncertainty'} <= r.parameters.keys()]


def population_table(records: Sequence[EffectRecord]) -> tuple[list[str], list[list[str]]]:
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


def population_figure(records: Sequence[EffectRecord]) -> Any:
    """Draw each channel's values with one sigma, and the population's width behind them.

    Returns None where no record is a population.
    """
    found = populations(records)
    if not found:
        return None
    from matplotlib import pyplot as plt  # late: it takes as long as all others

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


def choice_figure(calibration: Calibration) -> Any:
    """Draw held-out errors by the number of dipoles, and by damping for the six best layouts.

    Returns None where no layouts were compared.
    """
    if not calibration.candidates:
        return None
    from matplotlib import pyplot as plt

    from anser_ros.cli.page import legend_under

    picked = next(one for one in calibration.candidates if one.layout == calibration.layout)
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
