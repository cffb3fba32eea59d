"""Assess a tracker by the protocols that the field publishes, and watch it over sessions."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.apps.poses.assessment.history import judge, keep
from anser_ros.apps.poses.assessment.hummel import ORDERS, RING_STEP_DEG, SPACING_M
from anser_ros.apps.poses.assessment.protocols import (
    PROTOCOLS,
    Assessment,
    ProtocolOptions,
    assess,
)
from anser_ros.apps.poses.assessment.source import read_poses
from anser_ros.apps.poses.assessment.stillness import PauseRule
from anser_ros.apps.poses.cli.accuracy_report import figure_rows, qa_words, render, to_document
from anser_ros.apps.poses.cli.pose_source import add_source_options, source_of
from anser_ros.apps.poses.sequence import missing_words
from anser_ros.cli.output import (
    Result,
    Tell,
    add_json,
    add_list,
    add_out,
    make_folder,
    terminal_table,
    write_files,
)
from anser_ros.errors import ParameterError
from anser_ros.wire.text_files import numbers_of, read_rows

SEED = 1
"""Seed of the resamples, so that the same recordings give the same intervals."""
NO_DATE_NS = 10**18
"""Stamp, ns, before which a recording does not say when it was made: it would be of 2001."""
OPTICAL_TRUTH = 'optical'
COLORS = {'pass': 'green', 'note': 'yellow', 'alert': 'magenta', 'fail': 'red'}

Array = NDArray[np.float64]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    lines = '\n'.join(f'  {name:<15} {words}' for name, words in PROTOCOLS.items())
    parser.epilog = (
        f'protocols:\n{lines}\n\n'
        'example: anser accuracy dynamic bags/moving.mcap --model config/demo_model.yaml '
        '--out result/;\n'
        'with a recording of a board: '
        'anser accuracy grid board.mcap --topic /anser/pen/tip/pose --out result/;\n'
        'every day: anser accuracy rest daily.mcap --history qa/ '
        '--limit position_jitter_rms_m=5e-4'
    )
    parser.add_argument('protocol', choices=list(PROTOCOLS), help='what was recorded, see below')
    parser.add_argument(
        'recordings', nargs='+', type=Path,
        help='bag or file of poses; several files: one per point (grid, rotation, point-to-point)',
    )  # fmt: skip
    add_source_options(parser)
    parser.add_argument('--optical', metavar='TOPIC', help='topic of the reference')
    parser.add_argument(
        '--pause-s', type=float, default=PauseRule().least_s,
        help=f'shortest pause that counts as a point, s ({PauseRule().least_s:g})',
    )  # fmt: skip
    parser.add_argument('--grid', metavar='RxC', help='rows and columns of a board of your own')
    words = 'spacing of the holes of the board, mm (50)'
    parser.add_argument('--spacing-mm', type=float, default=1e3 * SPACING_M, help=words)
    words = 'rows: all in one direction; serpentine: every other one backwards'
    parser.add_argument('--order', choices=ORDERS, default=ORDERS[0], help=words)
    words = 'step of the holes of the ring, degrees (11.25)'
    parser.add_argument('--step-deg', type=float, default=RING_STEP_DEG, help=words)
    words = 'for a sensor without roll: the direction whose rotation is evaluated'
    parser.add_argument('--axis', metavar='X,Y,Z', help=words)
    parser.add_argument(
        '--truth', default=OPTICAL_TRUTH, metavar='FILE',
        help="CSV of the phantom's points in order (x_m,y_m,z_m or x_mm,y_mm,z_mm); without it "
        'the optical reference',
    )  # fmt: skip
    parser.add_argument(
        '--history', type=Path, metavar='DIR',
        help='judge by the earlier sessions in this folder (pass, note, alert, fail), and keep '
        'this one there',
    )  # fmt: skip
    words = 'largest size of a figure, beyond which the session fails'
    add_list(parser, '--limit', metavar='FIGURE=VALUE', help=words)
    add_out(parser, 'accuracy.json and report.html', required=False)
    add_json(parser, 'accuracy.json on stdout')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Assess the recordings of the arguments, and judge them where that is wanted."""
    options, tolerances = _options(args), _tolerances(args.limit)
    make_folder(args.out)
    make_folder(args.history)
    wanted = source_of(args)
    recordings = []
    for k, path in enumerate(args.recordings):
        tell('reading', k / len(args.recordings))
        recordings.append(read_poses(path, wanted))
    tell(args.protocol, 0.5)
    found = assess(args.protocol, recordings, options, np.random.default_rng(SEED))
    missing = tuple(filter(None, (missing_words(one.poses) for one in recordings)))
    found = replace(found, notes=(*found.notes, *missing))
    if found.start_ns < NO_DATE_NS:  # a device's own counter: the file says when
        found = replace(found, start_ns=args.recordings[0].stat().st_mtime_ns)
    is_judged = args.history is not None or bool(tolerances)
    verdict = judge(found, args.history, tolerances) if is_judged else None
    document = to_document(found, verdict)
    written: tuple[Path, ...] = ()
    if args.out is not None:
        page = render(found, document, verdict)
        written = write_files(args.out, {'accuracy.json': document, 'report.html': page})
    if verdict is not None and args.history is not None:
        written = (*written, keep(found, args.history, verdict.figures))
    return Result(document, (), _shown(found, document), written)


def _shown(found: Assessment, document: dict[str, Any]) -> tuple[Any, ...]:
    def coloured(state: str) -> str:
        return f'[{COLORS.get(state, "white")}]{state}[/]'

    qa = document.get('qa')
    head = ['figure', 'value', '95 % interval', *(['state'] if qa else [])]
    rows = [
        [*cells, *([coloured(state)] if qa else [])]
        for *cells, state in figure_rows(found, document)
    ]
    points = [f'{len(found.points)} points'] if found.points else []
    return (terminal_table(head, rows), *points, *found.notes, *([qa_words(qa)] if qa else []))


def _options(args: argparse.Namespace) -> ProtocolOptions:
    for name in ('pause_s', 'spacing_mm', 'step_deg'):
        if not (np.isfinite(getattr(args, name)) and getattr(args, name) > 0):
            raise ParameterError(f'--{name.replace("_", "-")} must be positive')
    grid = None
    if args.grid:
        parts = args.grid.lower().split('x')
        if len(parts) != 2 or not all(p.isdigit() and int(p) > 0 for p in parts):
            raise ParameterError(f'--grid takes ROWSxCOLUMNS such as 9x10, got {args.grid!r}')
        grid = int(parts[0]), int(parts[1])
    axis = None
    if args.axis:
        try:
            axis = np.array([float(v) for v in args.axis.split(',')])
        except ValueError as error:
            raise ParameterError(f'--axis takes three numbers, got {args.axis!r}') from error
        if axis.shape != (3,) or not np.linalg.norm(axis) > 0:
            raise ParameterError(f'--axis takes three numbers, got {args.axis!r}')
    truth = None
    if args.truth != OPTICAL_TRUTH and args.protocol == 'point-to-point':
        truth = _truth(Path(args.truth))
    rule = PauseRule()
    # Points of a narrow board, or of a fine ring, are not merged.
    apart_m = min(rule.apart_m, 0.2e-3 * args.spacing_mm)
    apart_rad = min(rule.apart_rad, 0.3 * np.deg2rad(args.step_deg))
    return ProtocolOptions(
        PauseRule(args.pause_s, apart_m, apart_rad), grid, 1e-3 * args.spacing_mm, args.step_deg,
        args.order, axis, truth,
    )  # fmt: skip


def _truth(path: Path) -> Array:
    """Points of a CSV, m, shape (n, 3)."""
    _, rows = read_rows(path)
    for unit, scale in (('m', 1.0), ('mm', 1e-3)):
        names = [f'{axis}_{unit}' for axis in 'xyz']
        if rows and all(name in rows[0] for name in names):
            return scale * numbers_of(path, rows, names)
    raise ParameterError(f'{path}: needs rows with the columns x_m, y_m, z_m, or x_mm, y_mm, z_mm')


def _tolerances(texts: list[str]) -> dict[str, float]:
    found = {}
    for text in texts:
        name, _, value = text.rpartition('=')
        try:
            found[name] = float(value)
        except ValueError as error:
            raise ParameterError(f'--limit takes FIGURE=VALUE, got {text!r}') from error
        if not name or not found[name] > 0:
            raise ParameterError(f'--limit takes FIGURE=VALUE with a positive value, got {text!r}')
    return found
