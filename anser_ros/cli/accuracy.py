"""Assess a tracker by the protocols that the field publishes, and watch it over sessions."""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from anser_ros.assessment.history import judge, keep
from anser_ros.assessment.hummel import ORDERS, RING_STEP_DEG, SPACING_M
from anser_ros.assessment.protocols import PROTOCOLS, Assessment, ProtocolOptions, assess
from anser_ros.assessment.source import read_poses
from anser_ros.assessment.stillness import PauseRule
from anser_ros.cli.accuracy_document import figure_rows, to_document
from anser_ros.cli.accuracy_page import render
from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import say_written
from anser_ros.cli.pose_source import add_source_options, source_of
from anser_ros.cli.progress import progress_of
from anser_ros.errors import ParameterError
from anser_ros.poses.sequence import missing_words
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
    parser.add_argument(
        '--spacing-mm',
        type=float,
        default=1e3 * SPACING_M,
        help='spacing of the holes of the board, mm (50)',
    )
    parser.add_argument(
        '--order', choices=ORDERS, default=ORDERS[0],
        help='rows: all in one direction; serpentine: every other one backwards',
    )  # fmt: skip
    parser.add_argument(
        '--step-deg',
        type=float,
        default=RING_STEP_DEG,
        help='step of the holes of the ring, degrees (11.25)',
    )
    parser.add_argument(
        '--axis',
        metavar='X,Y,Z',
        help='for a sensor without roll: the direction whose rotation is evaluated',
    )
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
    parser.add_argument(
        '--limit', action='append', default=[], metavar='FIGURE=VALUE',
        help='largest size of a figure, beyond which the session fails',
    )  # fmt: skip
    parser.add_argument(
        '--out', type=Path, help='folder for accuracy.json and report.html, made if missing'
    )
    parser.add_argument('--json', action='store_true', help='print accuracy.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    options, tolerances = _options(args), _tolerances(args.limit)
    for folder in filter(None, (args.out, args.history)):
        make_folder(folder)
    wanted = source_of(args)
    with progress_of('accuracy') as progress:
        recordings = []
        for k, path in enumerate(args.recordings):
            progress('reading', k / len(args.recordings))
            recordings.append(read_poses(path, wanted))
        progress(args.protocol, 0.5)
        found = assess(args.protocol, recordings, options, np.random.default_rng(SEED))
    missing = tuple(filter(None, (missing_words(one.poses) for one in recordings)))
    found = replace(found, notes=(*found.notes, *missing))
    if found.start_ns < NO_DATE_NS:  # a device's own counter: the file tells when
        found = replace(found, start_ns=args.recordings[0].stat().st_mtime_ns)
    is_judged = args.history is not None or bool(tolerances)
    verdict = judge(found, args.history, tolerances) if is_judged else None
    document = to_document(found, verdict)
    text = json.dumps(document, indent=1)
    written = []
    if args.out is not None:
        for name, content in (
            ('accuracy.json', text + '\n'), ('report.html', render(found, document, verdict))
        ):  # fmt: skip
            (args.out / name).write_text(content, encoding='utf-8')
            written.append(args.out / name)
    if verdict is not None and args.history is not None:
        written.append(keep(found, args.history, verdict.figures))
    if args.json:
        print(text)
        return 0
    _say(found, document)
    if written:
        say_written(*written)
    return 0


def _say(found: Assessment, document: dict[str, Any]) -> None:
    console = Console()
    qa = document.get('qa')
    head = ['figure', 'value', '95 % interval']
    shown = Table(*head, *(['state'] if qa else []))
    for name, value, interval, judged in figure_rows(found, document):
        color = COLORS.get(judged, 'white')
        shown.add_row(name, value, interval, *([f'[{color}]{judged}[/]'] if qa else []))
    console.print(shown)
    if found.points:
        console.print(f'{len(found.points)} points', highlight=False)
    for words in found.notes:
        console.print(words, highlight=False)
    if qa:
        words = ', '.join(
            f'{name}: {one["words"]}' for name, one in qa['figures'].items() if one['words']
        )
        console.print(
            f'[{COLORS[qa["state"]]}]{qa["state"]}[/], compared with {qa["earlier_sessions"]} '
            'earlier sessions' + (f': {words}' if words else ''), highlight=False,
        )  # fmt: skip


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
