"""Find what a model leaves unexplained on a session, name the effect, correct it."""

import argparse
import importlib

from anser_ros.cli import output
from anser_ros.cli.diagnosis_report import render
from anser_ros.cli.diagnosis_words import held_out_rows, verdict
from anser_ros.cli.sessions import add_session_kinds, named_kind, need_model, snapshot_notes
from anser_ros.sessions.diagnosis import diagnose_session, other_way, to_document
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import model_for, save_model


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser diagnose bags/moving.mcap --model config/demo_model.yaml --out result/'
    )
    parser.add_argument('session', help='bag to diagnose (.mcap file or bag folder)')
    output.add_out(parser, 'the results')
    add_options(parser)
    output.add_json(parser, 'diagnosis.json on stdout')


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options that hold for every session."""
    output.add_session_options(parser)
    add_session_kinds(parser)


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Diagnose the session of the arguments into its folder, by the way that it needs.

    A session of another tracker has a way of its own. One of too few poses to test a field model
    has the field estimated anew, all others are tested against the model.
    """
    if kind := named_kind(args):
        done: output.Result = kind.diagnose(args, tell)
        return done
    need_model(args)
    session = load_session(args.session).with_stated(output.stated_values(args))
    model = model_for(args.model, session, snapshot=True, resurveyed=args.resurveyed)
    baseline = load_session(args.baseline) if args.baseline else None
    output.make_folder(args.out)
    names = {'session': args.session, 'model': args.model}
    if way := other_way(session):
        other = way.diagnose(session, model, tell)
        tell('writing the report')
        document, corrected = way.to_document(other), other.model
        report = importlib.import_module(way.REPORT).render(other, document, **names)
    else:
        found = diagnose_session(session, model, baseline, tell)
        tell('writing the report')
        document, corrected = to_document(found), found.diagnosis.model
        report = render(found, document, **names)
    save_model(args.out / 'model.yaml', corrected)
    written = output.write_files(args.out, {'report.html': report, 'diagnosis.json': document})
    return output.Result(
        document,
        (*snapshot_notes(args.model, model), *output.loss_notes(args.session, session.lost)),
        (
            output.terminal_table(['held out', 'before', 'after'], held_out_rows(document)),
            verdict(document),
        ),
        (*written, args.out / 'model.yaml'),
    )
