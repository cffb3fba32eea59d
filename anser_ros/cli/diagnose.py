"""Find what a model leaves unexplained on a session, name the effect, correct it."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.table import Table

from anser_ros.cli.carry_out import carry_out
from anser_ros.cli.diagnosis_report import render
from anser_ros.cli.diagnosis_words import flux_unit, verdict
from anser_ros.cli.few_poses_report import render_few_poses
from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import Result, loss_notes, snapshot_notes
from anser_ros.cli.pose_session import add_pose_options, diagnose_pose_session, need_model
from anser_ros.cli.stated_values import add_resurveyed, add_stated_values, stated_values
from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import DEGREES
from anser_ros.sessions import few_poses
from anser_ros.sessions.calibration import is_estimated_jointly
from anser_ros.sessions.diagnosis import diagnose_session
from anser_ros.sessions.diagnosis_document import to_document
from anser_ros.sessions.model_file import save_model
from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.starting_model import model_for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser diagnose bags/moving.mcap --model config/demo_model.yaml --out result/'
    )
    parser.add_argument('session', help='bag to diagnose (.mcap file or bag folder)')
    parser.add_argument(
        '--out', required=True, type=Path, help='folder for the results, made if missing'
    )
    add_options(parser)
    parser.add_argument('--json', action='store_true', help='print diagnosis.json on stdout')


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options that hold for every session."""
    parser.add_argument('--model', help="model file, or 'nominal' for the setup's own geometry")
    parser.add_argument('--baseline', help='distortion-free recording of the same board')
    add_resurveyed(parser)
    add_pose_options(parser)
    add_stated_values(parser, 'accuracy', 'refit', 'tools')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    return carry_out('diagnose', 'diagnosing', work, args)


def work(args: argparse.Namespace, tell: Callable[[str], None]) -> Result:
    """Diagnose the session of the arguments into its folder.

    Parameters
    ----------
    args : argparse.Namespace
        Of `add_arguments`.
    tell : callable
        Called with words on what has been reached.
    """
    if args.poses:
        return diagnose_pose_session(args, tell)
    need_model(args)
    session = load_session(args.session).with_stated(stated_values(args))
    model = model_for(args.model, session, snapshot=True, resurveyed=args.resurveyed)
    baseline = load_session(args.baseline) if args.baseline else None
    make_folder(args.out)
    document, corrected, report = _diagnosed(args, session, model, baseline, tell)
    text = json.dumps(document, indent=1)
    (args.out / 'diagnosis.json').write_text(text + '\n', encoding='utf-8')
    save_model(args.out / 'model.yaml', corrected)
    (args.out / 'report.html').write_text(report, encoding='utf-8')
    return Result(
        document,
        (*snapshot_notes(args.model, model), *loss_notes(args.session, session.lost)),
        (_table(document), verdict(document)),
        tuple(args.out / name for name in ('report.html', 'model.yaml', 'diagnosis.json')),
    )


def _diagnosed(
    args: argparse.Namespace,
    session: Session,
    model: FieldModel,
    baseline: Session | None,
    tell: Callable[[str], None],
) -> tuple[dict[str, Any], FieldModel, str]:
    """The document, the model with what was found, and the report's page."""
    names = {'session': args.session, 'model': args.model}
    if is_estimated_jointly(session):
        few = few_poses.diagnose_few_poses(session, model, tell)
        document = few_poses.to_document(few)
        tell('writing the report')
        return document, few.model, render_few_poses(few, document, **names)
    result = diagnose_session(session, model, baseline, tell)
    tell('writing the report')
    document = to_document(result)
    return document, result.diagnosis.model, render(result, document, **names)


def _table(document: dict[str, Any]) -> Table:
    held, table = document['held_out'], Table('held out', 'before', 'after')
    factor, shown = flux_unit(held['flux_rms_before_t'])
    for label, key, unit, scale in (
        (f'flux residual, {shown}', 'flux_rms', 't', factor),
        ('position RMSE, mm', 'position_rmse', 'm', 1e3),
        ('orientation RMSE, deg', 'orientation_rmse', 'rad', DEGREES),
    ):
        cells = [held[f'{key}_{when}_{unit}'] for when in ('before', 'after')]
        if cells != [None, None]:
            table.add_row(label, *('-' if c is None else f'{scale * c:.4g}' for c in cells))
    return table
