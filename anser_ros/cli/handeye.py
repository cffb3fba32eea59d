"""Fit registration, lever arm, mount and clocks of two streams of poses, jointly."""

import argparse
import html
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import yaml
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from anser_ros.assessment.source import PoseSource, read_poses
from anser_ros.cli.folders import make_folder
from anser_ros.cli.html_page import page, table
from anser_ros.cli.output import say_written
from anser_ros.cli.pose_session import add_topic_options, load_poses
from anser_ros.cli.progress import progress_of
from anser_ros.errors import ParameterError
from anser_ros.field.plain_data import plain
from anser_ros.physics.constants import DEGREES
from anser_ros.pictures import image
from anser_ros.poses.convention import reading_words
from anser_ros.poses.document import finite
from anser_ros.poses.forms import ORDERS
from anser_ros.poses.hand_eye_fit import HandEye, fit_hand_eye, matrix_of, turn_of
from anser_ros.poses.importing import STAMPS, import_poses
from anser_ros.poses.sequence import PoseSession, missing_words
from anser_ros.sessions.units import LENGTH_M

SCHEMA = 'anser_handeye/1'
BAGS = ('.mcap', '.db3', '.bag')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        'example: anser handeye bags/moving.mcap --model config/demo_model.yaml --out result/;\n'
        'with files of poses: anser handeye em.csv --reference optical.tum --out result/'
    )
    parser.add_argument(
        'tracked', nargs='+', type=Path,
        help='a bag with both streams, or files of tracked poses (CSV, TUM, ToolTracker .tsv)',
    )  # fmt: skip
    parser.add_argument(
        '--reference', nargs='+', type=Path, default=[],
        help='files of the second stream, as many and in the same order',
    )  # fmt: skip
    add_topic_options(parser, 'stream')
    parser.add_argument(
        '--model', default='', help="track the bag's fluxes with this model (or 'nominal')"
    )
    parser.add_argument(
        '--body', default='', help='with --model: which tool, if there are several'
    )
    parser.add_argument(
        '--pairs', action='store_true',
        help='poses at rest: pair the n-th of one stream with the n-th of the other, without '
        'clocks',
    )  # fmt: skip
    parser.add_argument(
        '--stamps', choices=STAMPS, default='host', help='for files: which of their times to use'
    )
    parser.add_argument(
        '--unit', choices=list(LENGTH_M), help='for files: unit of the tracked positions'
    )
    parser.add_argument(
        '--quaternion',
        choices=list(ORDERS),
        help='for files: how the tracked quaternions are written',
    )
    parser.add_argument(
        '--out',
        type=Path,
        help='folder for handeye.yaml, handeye.json and report.html, made if missing',
    )
    parser.add_argument('--json', action='store_true', help='print handeye.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    session = _session(args)
    if args.out is not None:
        make_folder(args.out)
    with progress_of('hand-eye') as progress:
        found = fit_hand_eye(session, pairs=args.pairs, progress=progress)
    document = to_document(found)
    text = json.dumps(document, indent=1)
    if args.out is not None:
        files = {
            'handeye.yaml': yaml.safe_dump(document, sort_keys=False, default_flow_style=None),
            'handeye.json': text + '\n',
            'report.html': render(found, document),
        }
        for name, content in files.items():
            (args.out / name).write_text(content, encoding='utf-8')
    notes = [session.lost] if session.lost else []
    if found.convention is not None:
        notes.append(reading_words(found.convention))
    notes += filter(None, map(missing_words, session.streams.values()))
    for note in notes:
        print(f'anser handeye: {session.path}: {note}', file=sys.stderr)
    if args.json:
        print(text)
        return 0
    console = Console()
    console.print(_table(document))
    lines = (*clock_words(document), *left_out_words(document))
    for line in (*lines, *(f'not determined: {w}' for w in found.undetermined)):
        console.print(line, highlight=False)
    if args.out is not None:
        say_written(*(args.out / name for name in files))
    return 0


def _session(args: argparse.Namespace) -> PoseSession:
    first = args.tracked[0]
    if first.is_dir() or first.suffix in BAGS:
        if len(args.tracked) > 1 or args.reference:
            raise ParameterError('one bag has both streams; --reference is for files of poses')
        if args.model:
            if args.topics or args.optical:
                raise ParameterError('--model tracks the fluxes of a body and takes no topics')
            return read_poses(first, PoseSource(model=args.model, body=args.body)).session
        return load_poses(first, args)
    if args.topics or args.optical or args.model:
        raise ParameterError('--tracked, --model and --optical need a bag')
    return import_poses(
        args.tracked, args.reference, stamps=args.stamps, unit=args.unit,
        quaternion=args.quaternion,
    )  # fmt: skip


def to_document(found: HandEye) -> dict[str, Any]:
    """Return the result as plain data; null if it is not determined."""
    vector, quaternion = turn_of(found.rotation)
    offset, rate = (pair or (None, None) for pair in (found.offset_s, found.rate_ppm))
    document: dict[str, Any] = {
        'schema': SCHEMA,
        'recording': found.session.path,
        'registration_rotation_deg': vector,
        'registration_rotation_sigma_deg': np.rad2deg(found.rotation_sigma_rad).tolist(),
        'registration_quaternion_xyzw': quaternion,
        'registration_translation_m': found.translation_m.tolist(),
        'registration_translation_sigma_m': found.translation_sigma_m.tolist(),
        'registration_matrix': matrix_of(found.rotation, found.translation_m).tolist(),
        'clock': {
            'offset_s': offset[0],
            'offset_sigma_s': offset[1],
            'rate_ppm': rate[0],
            'rate_sigma_ppm': rate[1],
            'middle_s': found.middle_s,
        },
        'sensors': {},
        'undetermined': list(found.undetermined),
        'convention': None if found.convention is None else plain(found.convention.parameters),
    }
    for name, one in found.sensors.items():
        turned = (None, None) if one.mount is None else turn_of(one.mount)
        document['sensors'][name] = {
            'lever_arm_m': one.lever_m.tolist(),
            'lever_arm_sigma_m': one.lever_sigma_m.tolist(),
            'mount_rotation_deg': turned[0],
            'mount_rotation_sigma_deg': np.rad2deg(one.mount_sigma_rad).tolist(),
            'mount_quaternion_xyzw': turned[1],
            'n': one.n, 'n_compared': one.n_compared,
            'position_rmse_m': one.rms[0], 'orientation_rmse_rad': one.rms[1],
            'heldout_position_rmse_m': one.held_out[0],
            'heldout_orientation_rmse_rad': one.held_out[1],
        }  # fmt: skip
    return dict(finite(document))


def left_out_words(document: dict[str, Any]) -> list[str]:
    """Return how many poses of each sensor contradict the others, where some do."""
    return [
        f'{name}: {one["n_compared"] - one["n"]} of {one["n_compared"]} poses contradict the '
        f'others, and are counted only in the held-out error'
        for name, one in document['sensors'].items()
        if one['n'] < one['n_compared']
    ]


def clock_words(document: dict[str, Any]) -> list[str]:
    """Return what is known of the clocks, in lines."""
    lines, clock = [], document['clock']
    if clock['offset_s'] is not None:
        late = 'late' if clock['offset_s'] > 0 else 'early'
        lines.append(
            f'clocks: tracked stamps are {1e3 * abs(clock["offset_s"]):.1f} '
            f'± {1e3 * clock["offset_sigma_s"]:.1f} ms {late}'
        )
    if clock['rate_ppm'] is not None:
        gains = 'gains' if clock['rate_ppm'] > 0 else 'loses'
        lines.append(
            f'clocks: the tracked one {gains} {abs(clock["rate_ppm"]):.0f} '
            f'± {clock["rate_sigma_ppm"]:.0f} ppm'
        )
    return lines


HEAD = ('sensor', 'lever arm, mm', '1 sigma', 'mount, deg', '1 sigma', 'rms, mm', 'held out, mm',
        'held out, deg')  # fmt: skip


def _rows(document: dict[str, Any], digits: int) -> list[list[str]]:
    def triple(values: list[float | None] | None, scale: float) -> str:
        if values is None:
            return '-'
        return ' '.join('-' if v is None else f'{scale * v:.{digits}f}' for v in values)

    def single(value: float | None, scale: float) -> str:
        return '-' if value is None else f'{scale * value:.2f}'

    return [
        [
            name, triple(one['lever_arm_m'], 1e3), triple(one['lever_arm_sigma_m'], 1e3),
            triple(one['mount_rotation_deg'], 1.0), triple(one['mount_rotation_sigma_deg'], 1.0),
            single(one['position_rmse_m'], 1e3), single(one['heldout_position_rmse_m'], 1e3),
            single(one['heldout_orientation_rmse_rad'], DEGREES),
        ]
        for name, one in document['sensors'].items()
    ]  # fmt: skip


SHOWN_COLUMNS = (0, 1, 2, 3, 6)
"""Columns of `HEAD` that fit into a terminal of eighty letters."""


def _table(document: dict[str, Any]) -> Table:
    shown = Table()
    for column in SHOWN_COLUMNS:
        shown.add_column(HEAD[column], no_wrap=True)
    for row in _rows(document, 1):
        shown.add_row(*(row[column] for column in SHOWN_COLUMNS))
    return shown


def render(found: HandEye, document: dict[str, Any]) -> str:
    """Return the page as HTML: frames, clocks, what is open, and what is left over time."""
    columns = [
        (scale, document[f'registration_{key}'])
        for scale, key in (
            (1e3, 'translation_m'), (1e3, 'translation_sigma_m'),
            (1.0, 'rotation_deg'), (1.0, 'rotation_sigma_deg'),
        )
    ]  # fmt: skip
    rows = [
        [axis, *('-' if v[k] is None else f'{scale * v[k]:.3f}' for scale, v in columns)]
        for k, axis in enumerate('xyz')
    ]
    open_ones = ''.join(f'<li>{html.escape(words)}</li>' for words in found.undetermined)
    lines = [*clock_words(document), *left_out_words(document)]
    clocks = '; '.join(lines) or 'the clocks were not compared'
    return page('Hand-eye', [
        '<h1>Hand-eye calibration</h1>'
        f'<p class="note"><code>{html.escape(found.session.path)}</code></p>'
        f'<p class="verdict">{html.escape(clocks)}</p>'
        + (f'<p class="note">{html.escape(reading_words(found.convention))}</p>'
           if found.convention is not None else ''),
        '<h2>Sensors on the body</h2>', table(HEAD, _rows(document, 2)),
        "<h2>From the optical frame to the tracker's</h2>",
        table(('axis', 'translation, mm', '1 sigma', 'rotation vector, deg', '1 sigma'), rows),
        f'<h2>Not determined</h2><ul>{open_ones}</ul>' if open_ones else '',
        '<h2>Residuals over time</h2>', image(_over_time(found)),
    ])  # fmt: skip


def _over_time(found: HandEye) -> Figure:
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    for part in found.fit.state.parts:
        size = 1e3 * np.linalg.norm(part.residual[part.used, :3], axis=1)
        axes.plot(part.view.time[part.used], size, '.', ms=2, label=part.view.sensor)
    axes.set(xlabel='time, s', ylabel='distance, mm', yscale='log')
    figure.legend(loc='outside right upper')
    return figure
