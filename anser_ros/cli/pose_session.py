"""Takes sessions of trackers that give poses only: options, diagnosis and evaluation."""

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import Result, loss_notes, number, terminal_table, write_files
from anser_ros.cli.pose_report import pose_verdict, render_poses
from anser_ros.cli.progress import Tell
from anser_ros.cli.stated_values import add_list
from anser_ros.errors import ParameterError
from anser_ros.physics.constants import DEGREES
from anser_ros.poses.diagnosis import PoseDiagnosis, diagnose_poses
from anser_ros.poses.document import to_document, to_model
from anser_ros.poses.recording import read_pose_session
from anser_ros.poses.sequence import PoseSession


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a session of poses."""
    add_topic_options(parser, 'sensor', 'with --poses: ')


def add_topic_options(parser: argparse.ArgumentParser, what: str, when: str = '') -> None:
    """Declare the options that name topics of poses in a bag."""
    add_list(
        parser, '--tracked', metavar='NAME=TOPIC', dest='topics',
        help=f'{when}a tracked {what} and its topic, by default all /tracked/<sensor>/pose',
    )  # fmt: skip
    parser.add_argument(
        '--optical', metavar='TOPIC',
        help=f'{when}topic of the reference, by default the only /optical/<body>/pose',
    )  # fmt: skip


def load_poses(path: Path | str, args: argparse.Namespace) -> PoseSession:
    """Load the session that the options name."""
    topics = {}
    for text in args.topics:
        name, _, topic = text.partition('=')
        if not name or not topic:
            raise ParameterError(f'--tracked takes NAME=TOPIC, got {text!r}')
        topics[name] = topic
    return read_pose_session(path, topics or None, args.optical)


def diagnose(args: argparse.Namespace, tell: Tell) -> Result:
    """Diagnose a session of poses into the folder of the arguments."""
    found, document = _found(args, tell)
    written = write_files(
        args.out,
        {
            'diagnosis.json': document,
            'model.yaml': yaml.safe_dump(to_model(found), sort_keys=False),
            'report.html': render_poses(found, document, str(args.session)),
        },
    )
    return _result(args, found, document, document, written)


def evaluate(args: argparse.Namespace, tell: Tell) -> Result:
    """Report the errors of a session of poses, into the folder of the arguments."""
    found, diagnosis = _found(args, tell)
    document = _evaluation(found, diagnosis)
    written = write_files(args.out, {'evaluation.json': document})
    _write_poses(args.out / 'poses.csv', found)
    return _result(args, found, document, diagnosis, (*written, args.out / 'poses.csv'))


def _found(args: argparse.Namespace, tell: Tell) -> tuple[PoseDiagnosis, dict[str, Any]]:
    session = load_poses(args.session, args)
    make_folder(args.out)
    found = diagnose_poses(session, tell)
    return found, to_document(found)


def _result(
    args: argparse.Namespace, found: PoseDiagnosis, document: dict[str, Any],
    diagnosis: dict[str, Any], written: tuple[Path, ...],
) -> Result:  # fmt: skip
    rows = [
        [
            name,
            *(number(row[f'position_rmse_{key}_m'], 1e3, '.2f')
              for key in ('registration_only', 'before', 'after')),
            number(row['orientation_rmse_after_rad'], DEGREES, '.2f'),
        ]
        for name, row in diagnosis['sensors'].items()
    ]  # fmt: skip
    head = ['sensor', 'registration mm', 'hand-eye mm', 'effects mm', 'effects deg']
    shown = terminal_table(head, rows), pose_verdict(diagnosis)
    return Result(document, loss_notes(args.session, found.session.lost), shown, written)


def _evaluation(found: PoseDiagnosis, document: dict[str, Any]) -> dict[str, Any]:
    """The errors of every sensor with the frames and effects that were found."""
    sensors: dict[str, Any] = {}
    for part in found.fit.state.parts:
        name = part.view.sensor
        row: dict[str, Any] = {'n': int(np.count_nonzero(part.used))}
        poses = found.session.sensors[name]
        row['tracked_fraction'] = poses.size / max(poses.size + poses.missing.size, 1)
        for key, unit, columns in (
            ('position', 'm', slice(0, 3)),
            ('orientation', 'rad', slice(3, 6)),
        ):
            size = np.linalg.norm(part.residual[part.used, columns], axis=1)
            row |= {
                f'{key}_rmse_{unit}': float(np.sqrt(np.mean(size**2))),
                f'{key}_me_{unit}': float(size.mean()),
                f'{key}_prc50_{unit}': float(np.percentile(size, 50)),
                f'{key}_prc95_{unit}': float(np.percentile(size, 95)),
            }
        sensors[name] = row
    return {
        'schema': 'anser_evaluation/1', 'sensors': sensors, 'bodies': {},
        'held_out': document['held_out'],
    }  # fmt: skip


def _write_poses(path: Path, found: PoseDiagnosis) -> None:
    """Write the corrected poses in the optical body's prediction frame, a row each."""
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(['stamp_ns', 'sensor', 'x_m', 'y_m', 'z_m', 'distance_m', 'angle_rad',
                         'status'])  # fmt: skip
        for part in found.fit.state.parts:
            stamps = found.session.start_ns + np.round(1e9 * part.view.time).astype(np.int64)
            place = part.view.position + part.residual[:, :3]
            for k, stamp in enumerate(stamps.tolist()):
                size = [np.linalg.norm(part.residual[k, :3]), np.linalg.norm(part.residual[k, 3:])]
                status = 'ok' if part.used[k] else 'outlier_or_no_reference'
                values = [f'{v:.9g}' for v in (*place[k], *size)]
                writer.writerow([stamp, part.view.sensor, *values, status])
