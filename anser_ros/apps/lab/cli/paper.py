"""Redoes the article's experiments: Tables II to V, Figs. 2 and 5 to 10."""

import argparse
import tempfile
from pathlib import Path

from anser_ros.apps.lab.experiments.recordings import (
    Recordings,
    given_recordings,
    missing,
    simulate_recordings,
)
from anser_ros.apps.lab.experiments.report import draw_all, write_report
from anser_ros.apps.lab.experiments.study import Study
from anser_ros.apps.lab.measured.recipe import shared_folder
from anser_ros.cli import output

SHOWN_TABLES = (
    'table_2',
    'table_3 aluminium',
    'table_3 mu-metal',
    'table_4 unshielded',
    'table_4 aluminium',
    'table_4 mu-metal',
    'table_5 compensated',
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = 'example: anser paper --simulate --out paper/'
    words = 'folder of the recordings; by default the shared ones, or simulated'
    parser.add_argument('--sessions', type=Path, help=words)
    output.add_out(parser, 'the report', required=False, default=Path('out/paper'))
    parser.add_argument('--simulate', action='store_true', help='simulate the recordings anyway')
    parser.add_argument('--seed', type=int, default=1, help='seed of the simulated recordings')
    output.add_json(parser, 'paper.json on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Redo the experiments."""
    output.make_folder(args.out)
    with tempfile.TemporaryDirectory() as scratch:
        study = Study(_recordings(args, Path(scratch)), tell)
        results = study.run()
        figures = draw_all(study, args.out)
    document = results.document()
    report = args.out / 'paper.md'
    write_report(document, figures, report)
    rows = [
        [
            experiment.replace('_', ' '),
            method,
            *(f'{errors[s].millimetres()["RMSE"]:.3f}' for s in ('Y', 'Z')),
        ]
        for experiment in SHOWN_TABLES
        for method, errors in results.tracking[experiment].items()
    ]
    title = f'position RMSE, mm; simulated data ({results.origin})'
    shown = output.terminal_table(['experiment', 'method', 'Y', 'Z'], rows, title=title)
    return output.Result(
        document, (), (shown,), (report, *output.write_files(args.out, {'paper.json': document}))
    )


def _recordings(args: argparse.Namespace, scratch: Path) -> Recordings:
    """Return the recordings asked for, the shared ones, or else ones simulated here."""
    folder = args.sessions or shared_folder() / 'sessions' / 'paper'
    if args.simulate or (args.sessions is None and missing(folder)):
        return simulate_recordings(scratch, args.seed)
    return given_recordings(folder)
