"""Track recorded sessions and compare their poses with the optical ones."""

import argparse
from pathlib import Path
from typing import Any

from anser_ros.cli.commands import SESSION_KINDS
from anser_ros.cli.evaluation_figures import ERRORS_HEAD, error_rows, write_figures
from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import Result, loss_notes, terminal_table, write_files
from anser_ros.cli.progress import Tell
from anser_ros.cli.session_kinds import add_session_kinds, named_kind, need_model, snapshot_notes
from anser_ros.cli.session_runs import perform, runs_of, summed_up
from anser_ros.cli.stated_values import (
    add_json,
    add_session_options,
    stated_values,
)
from anser_ros.errors import ParameterError
from anser_ros.sessions.chosen_references import parse_references, with_references
from anser_ros.sessions.evaluation import track_session
from anser_ros.sessions.evaluation_document import recording_of, to_document
from anser_ros.sessions.known_metal import models_of
from anser_ros.sessions.pose_table import write_tables
from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.starting_model import model_for
from anser_ros.tracking.estimate import TrackerSettings

ALONE = ('refit', 'baseline', 'references', 'witnesses', 'in_phase', *SESSION_KINDS)
"""Options that do not go together with ``--known-metal``."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser evaluate bags/metal.mcap --model config/demo_model.yaml'
        ' --refit --baseline bags/scan.mcap --out refit/'
    )
    parser.add_argument(
        'sessions', nargs='+', metavar='BAG', help='bags to track (.mcap files or bag folders)'
    )
    parser.add_argument(
        '--out', required=True, type=Path,
        help='folder for the results, made if missing; with several bags each has a folder in '
        'it, and summary.csv and summary.html summarise them',
    )  # fmt: skip
    add_options(parser)
    add_json(parser, 'evaluation.json, or the summary, on stdout')


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options that hold for every session."""
    add_session_options(parser)
    parser.add_argument(
        '--refit', action='store_true', help='let the model follow the reference sensors'
    )
    parser.add_argument(
        '--references', metavar='CHANNEL,...|none',
        help='reference sensors that the refit may use; the others are ignored',
    )  # fmt: skip
    parser.add_argument(
        '--witnesses', action='store_true',
        help='let the refit also use contradictions among the coils of rigid tools; for few '
        'references',
    )  # fmt: skip
    parser.add_argument(
        '--known-metal', type=Path, metavar='FILE',
        help='metal that anser known_metal has learnt: let the model follow it by the tools, '
        'without references',
    )  # fmt: skip
    parser.add_argument(
        '--in-phase', action='store_true', help="use in-phase fluxes only, the article's way"
    )
    parser.add_argument(
        '--gate', type=float, default=TrackerSettings().gate,
        help='largest residual of a pose, in units of the expected one; inf withholds none (only '
        'to see the error that a wrong model would cause)',
    )  # fmt: skip
    add_session_kinds(parser)


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Evaluate the session of the arguments into its folder; several one after the other."""
    if len(args.sessions) == 1:
        args.session = args.sessions[0]
        return _one(args, tell)
    runs = runs_of('evaluate', args)
    make_folder(args.out)
    outcomes = []
    for count, one in enumerate(runs):
        tell('evaluating', count / len(runs))
        outcomes.append(perform(one))
    return summed_up('evaluate', outcomes, args.out)


def _one(args: argparse.Namespace, tell: Tell) -> Result:
    given = [f'--{name.replace("_", "-")}' for name in ALONE if getattr(args, name)]
    if args.known_metal is not None and given:
        raise ParameterError(
            f'--known-metal follows metal by the tools alone; leave out {", ".join(given)}'
        )
    if kind := named_kind(args):
        done: Result = kind.evaluate(args, tell)
        return done
    need_model(args)
    session = load_session(args.session).with_stated(stated_values(args))
    if args.witnesses and not args.refit:
        raise ParameterError('--witnesses extends the refit; it needs --refit')
    if args.references is not None:
        if not args.refit:
            raise ParameterError('--references chooses those of a refit; it needs --refit')
        session = with_references(session, parse_references(args.references))
    model = model_for(args.model, session, snapshot=True, resurveyed=args.resurveyed)
    baseline = load_session(args.baseline) if args.baseline else None
    known = None if args.known_metal is None else models_of(args.known_metal)
    make_folder(args.out)
    evaluation = track_session(
        session, model, TrackerSettings(gate=args.gate), baseline=baseline, refit=args.refit,
        in_phase=args.in_phase, witnesses=args.witnesses, models=known,
        progress=lambda share: tell('tracking', share),
    )  # fmt: skip
    document = {**to_document(evaluation), 'recording': recording_of(session)}
    written = list(write_files(args.out, {'evaluation.json': document}))
    written += write_tables(args.out, evaluation)
    written += write_figures(
        evaluation, document, args.out, session=args.session, model=args.model,
        jitter_m=session.setup.accuracy.optical_position_m,
    )[-1:]  # fmt: skip
    shown: list[Any] = [terminal_table(ERRORS_HEAD, error_rows(document))]
    if 'refit' in document:
        shown.append(_refit_line(document['refit'], known is not None))
    notes = (
        *snapshot_notes(args.model, model), *loss_notes(args.session, session.lost),
        *(_few_notes(session) if args.refit else ()),
    )  # fmt: skip
    return Result(document, notes, tuple(shown), tuple(written))


def _few_notes(session: Session) -> tuple[str, ...]:
    """State why a refit gives no pose, where it has fewer references than it takes."""
    count = 0 if session.reference is None else len(session.reference.sensors)
    need = session.setup.refit.min_references
    if count >= need:
        return ()
    return (
        f'a refit with {count} reference sensors gives no pose, because min_references is '
        f'{need}; evaluate without --refit, or --set min_references={max(count, 1)}',
    )


def _refit_line(refit: dict[str, dict[str, int]], known: bool) -> str:
    """What the refit did, in a line."""
    states = ', '.join(f'{name} in {count} frames' for name, count in refit['states'].items())
    out = ', '.join(f'{name} in {count}' for name, count in refit['left_out'].items())
    if known:
        return f'known metal: {states}'
    return f'refit: {states or "no frame"}; left out: {out or "no reference"}'
