"""Fits a field model to recorded sessions."""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.table import Table

from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.result import Calibration, to_document
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.cli.calibration_figures import (
    choice_figure,
    population_figure,
    population_table,
    populations,
)
from anser_ros.cli.output import (
    Result,
    Tell,
    add_json,
    add_stated_values,
    check_file,
    loss_notes,
    make_folder,
    stated_values,
    terminal_table,
    write_files,
)
from anser_ros.errors import FitError, ParameterError
from anser_ros.field.model import EffectRecord
from anser_ros.physics.constants import DEGREES
from anser_ros.sessions.calibration import calibrate_sessions, check_same_board, named_kinds
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import save_model

MOST_LISTED = 40
"""Entries of a list that are shown; of more, their number is."""
LONG = ('values', 'uncertainty', 'axes')
"""Parameters of a population that are tables, which are shown by themselves."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = 'example: anser calibrate bags/scan.mcap --out model.yaml --report report/'
    parser.add_argument('sessions', nargs='+', metavar='SESSION', help='bags to learn from')
    words = 'model file to write; its folder is made if missing'
    parser.add_argument('--out', required=True, type=Path, help=words)
    words = 'folder for calibration.json and choice.png, made if missing'
    parser.add_argument('--report', type=Path, help=words)
    add_options(parser)
    add_json(parser, 'calibration.json on stdout')


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options that hold for every calibration."""
    parser.add_argument(
        '--force', action='store_true',
        help="write the model even when its held-out error is worse than the nominal model's",
    )  # fmt: skip
    parser.add_argument(
        '--dipoles', type=_layer, metavar='NxN',
        help='use a layer of N x N z-dipoles on the board; chosen by held-out error by default',
    )  # fmt: skip
    parser.add_argument(
        '--estimate', type=_kinds, default=KINDS, metavar='LIST',
        help='errors of sensors and clock to estimate together with the field, where the scan '
        f'supports them; "none" trusts the setup for all; by default {",".join(KINDS)}; '
        f'{",".join(named_kinds())} only when named',
    )  # fmt: skip
    parser.add_argument(
        '--damping', type=float, help='damping of the moments; chosen by held-out error by default'
    )
    add_stated_values(parser, 'accuracy')


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


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Calibrate with the sessions of the arguments, into their files.

    Raises `FitError` when the nominal model is better, and that is not forced.
    """
    stated = stated_values(args)
    options = _options(args)
    sessions = [load_session(path).with_stated(stated) for path in args.sessions]
    check_same_board(sessions)
    check_file(args.out)
    make_folder(args.report)
    calibration = calibrate_sessions(sessions, options, tell)
    document = to_document(calibration)
    if args.report is not None:
        figures = {
            'choice.png': choice_figure(calibration),
            'populations.png': population_figure(calibration.scan.corrections),
        }
        write_files(args.report, {'calibration.json': document, **figures})
    if not calibration.better_than_nominal and not args.force:
        raise FitError(
            f'no model written: its held-out error {document["heldout_flux_rmse_t"]:.3g} T is '
            f"worse than the nominal model's {calibration.nominal_rmse_t:.3g} T; "
            '--force writes it'
        )
    save_model(args.out, calibration.model)
    lost = [loss_notes(path, one.lost) for path, one in zip(args.sessions, sessions, strict=True)]
    return Result(
        document,
        (*sum(lost, ()), *document['unobservable'], *document['contradictions']),
        (_table(calibration, document), *_populations(calibration)),
        tuple(filter(None, (args.out, args.report))),
    )


def _options(args: argparse.Namespace) -> Options:
    if not 0.0 <= (args.damping or 0.0) < math.inf:
        raise ParameterError(f'damping must not be negative, got {args.damping:g}')
    return Options(layout=args.dipoles, damping=args.damping, estimate=args.estimate)


def _table(calibration: Calibration, document: dict[str, Any]) -> Table:
    rows = [
        ('readings per emitter', f'{document["n_measurements"]}'),
        ('dipoles', calibration.layout.describe()),
        ('damping', f'{calibration.damping:g}'),
        ('residual, T rms', f'{document["flux_rmse_t"]:.4g}'),
        ('held out, T rms', f'{document["heldout_flux_rmse_t"]:.4g}'),
        ('held out, % of the range', f'{document["heldout_n_rmse_percent"]:.4f}'),
        ("the field model's own error, T", f'{calibration.held_out.flux_error_t:.3g}'),
        ('noise, T a component', f'{calibration.fit.noise_t:.3g}'),
    ]
    if optical := document['optical_noise']:
        position, rotation = 1e3 * optical['position_m'], DEGREES * optical['rotation_rad']
        jitter = f'{position:.3f} mm, {rotation:.4f} deg'
        rows.append(('optical jitter a component, at most', jitter))
    rows += [(effect.name, _parameters(effect)) for effect in calibration.model.effects]
    for effect in calibration.scan.reported_effects:
        rows.append((f'{effect.name}, not in the model', _parameters(effect)))
    return terminal_table(['', ''], rows, title='calibration', show_header=False)


def _parameters(effect: EffectRecord) -> str:
    found = {k: v for k, v in effect.parameters.items() if k not in LONG}
    return ', '.join(f'{k} {_short(v)}' for k, v in found.items())


def _populations(calibration: Calibration) -> Iterator[Table]:
    """A table of each kind in which the sensors differ, as far as the scan says that they do."""
    for record in populations(calibration.scan.corrections):
        head, rows = population_table([record])
        names = [name.removeprefix(f'{record.name} ') for name in head]
        yield terminal_table(names, rows, title=record.name)


def _short(value: Any) -> str:
    if isinstance(value, list) and len(value) > MOST_LISTED:
        return f'{len(value)} of them'
    if isinstance(value, list):
        return '[' + ' '.join(_short(v) for v in value) + ']'
    return f'{value:.5g}' if isinstance(value, float) else str(value)
