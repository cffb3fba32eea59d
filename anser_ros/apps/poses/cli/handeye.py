"""Fit registration, lever arm, mount and clocks of two streams of poses, jointly."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from anser_ros.apps.poses.assessment.source import PoseSource, is_bag, read_poses
from anser_ros.apps.poses.cli.import_poses import add_form_options
from anser_ros.apps.poses.cli.pose_session import add_topic_options, load_poses, over_time
from anser_ros.apps.poses.convention import reading_words
from anser_ros.apps.poses.corrector import as_document
from anser_ros.apps.poses.hand_eye import HandEye, fit_hand_eye, turn_of
from anser_ros.apps.poses.importing import import_poses
from anser_ros.apps.poses.sequence import PoseSession, missing_words
from anser_ros.cli import output
from anser_ros.cli.page import heading, listed, page, paragraph, picture, table, top
from anser_ros.errors import ParameterError
from anser_ros.physics.constants import DEGREES

SCHEMA = 'anser_handeye/1'


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
    add_form_options(parser, 'for files: ')
    output.add_out(parser, 'handeye.yaml, handeye.json and report.html', required=False)
    output.add_json(parser, 'handeye.json on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Fit both streams."""
    session = _session(args)
    output.make_folder(args.out)
    found = fit_hand_eye(session, pairs=args.pairs, progress=tell)
    document = to_document(found)
    written: tuple[Path, ...] = ()
    if args.out is not None:
        files = {
            'handeye.yaml': yaml.safe_dump(document, sort_keys=False, default_flow_style=None),
            'handeye.json': document, 'report.html': render(found, document),
        }  # fmt: skip
        written = output.write_files(args.out, files)
    notes = [session.lost] if session.lost else []
    if found.convention is not None:
        notes.append(reading_words(found.convention))
    notes += filter(None, map(missing_words, session.streams.values()))
    rows = [[row[column] for column in SHOWN_COLUMNS] for row in _rows(document, 1)]
    table = output.terminal_table([HEAD[column] for column in SHOWN_COLUMNS], rows)
    for column in table.columns:
        column.no_wrap = True
    lines = (*clock_words(document), *left_out_words(document))
    shown = (table, *lines, *(f'not determined: {words}' for words in found.undetermined))
    return output.Result(
        document, tuple(f'{session.path}: {note}' for note in notes), shown, written
    )


def _session(args: argparse.Namespace) -> PoseSession:
    first = args.tracked[0]
    if is_bag(first):
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
        quaternion=args.quaternion, shift_s=(args.shift, args.shift_reference),
    )  # fmt: skip


def to_document(found: HandEye) -> dict[str, Any]:
    """Return the result as plain data; null if it is not determined."""
    vector, quaternion = turn_of(found.rotation)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = found.rotation, found.translation_m
    offset, rate = (pair or (None, None) for pair in (found.offset_s, found.rate_ppm))
    return as_document({
        'schema': SCHEMA,
        'recording': found.session.path,
        'registration_rotation_deg': vector,
        'registration_rotation_sigma_deg': np.rad2deg(found.rotation_sigma_rad),
        'registration_quaternion_xyzw': quaternion,
        'registration_translation_m': found.translation_m,
        'registration_translation_sigma_m': found.translation_sigma_m,
        'registration_matrix': matrix,
        'clock': {
            'offset_s': offset[0],
            'offset_sigma_s': offset[1],
            'rate_ppm': rate[0],
            'rate_sigma_ppm': rate[1],
            'middle_s': found.middle_s,
        },
        'sensors': found.sensors,
        'undetermined': found.undetermined,
        'convention': None if found.convention is None else found.convention.parameters,
    })  # fmt: skip


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
    clock = document['clock']
    lines = []
    if (offset := clock['offset_s']) is not None:
        late = 'late' if offset > 0 else 'early'
        sigma = 1e3 * clock['offset_sigma_s']
        lines.append(f'clocks: tracked stamps are {1e3 * abs(offset):.1f} ± {sigma:.1f} ms {late}')
    if (rate := clock['rate_ppm']) is not None:
        gains = 'gains' if rate > 0 else 'loses'
        sigma = clock['rate_sigma_ppm']
        lines.append(f'clocks: the tracked one {gains} {abs(rate):.0f} ± {sigma:.0f} ppm')
    return lines


HEAD = ('sensor', 'lever arm, mm', '1 sigma', 'mount, deg', '1 sigma', 'rms, mm', 'held out, mm',
        'held out, deg')  # fmt: skip


def _rows(document: dict[str, Any], digits: int) -> list[list[str]]:
    def triple(values: list[float | None] | None, scale: float) -> str:
        return ' '.join(output.number(v, scale, f'.{digits}f') for v in values or [None])

    return [
        [
            name, triple(one['lever_arm_m'], 1e3), triple(one['lever_arm_sigma_m'], 1e3),
            triple(one['mount_rotation_deg'], 1.0), triple(one['mount_rotation_sigma_deg'], 1.0),
            output.number(one['position_rmse_m'], 1e3, '.2f'),
            output.number(one['heldout_position_rmse_m'], 1e3, '.2f'),
            output.number(one['heldout_orientation_rmse_rad'], DEGREES, '.2f'),
        ]
        for name, one in document['sensors'].items()
    ]  # fmt: skip


SHOWN_COLUMNS = (0, 1, 2, 3, 6)
"""Columns of `HEAD` that fit into a terminal of eighty letters."""


def render(found: HandEye, document: dict[str, Any]) -> str:
    """Return the page as HTML: frames, clocks, what is open, and what is left over time."""
    columns = [
        (document[f'registration_{key}'], scale)
        for key, scale in (
            ('translation_m', 1e3), ('translation_sigma_m', 1e3), ('rotation_deg', 1.0),
            ('rotation_sigma_deg', 1.0),
        )
    ]  # fmt: skip
    lines = [*clock_words(document), *left_out_words(document)]
    is_open, state = bool(found.undetermined), found.fit.state
    parts = enumerate(state.parts)
    each = {part.view.sensor: (replace(state, parts=(part,)), f'C{k}') for k, part in parts}
    return page(
        'Hand-eye',
        top(
            'Hand-eye calibration',
            '; '.join(lines) or 'the clocks were not compared',
            recording=found.session.path,
        ),
        paragraph(reading_words(found.convention) if found.convention else '', 'note'),
        heading('Sensors on the body'),
        table(HEAD, _rows(document, 2)),
        heading("From the optical frame to the tracker's"),
        table(
            ['axis', 'translation, mm', '1 sigma', 'rotation vector, deg', '1 sigma'],
            [
                [axis, *(output.number(values[k], scale) for values, scale in columns)]
                for k, axis in enumerate('xyz')
            ],
        ),
        [heading('Not determined'), listed(found.undetermined)] if is_open else [],
        heading('Residuals over time'),
        picture(over_time(each)),
    )
