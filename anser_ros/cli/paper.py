"""Redoes the article's experiments: Tables II to V, Figs. 2 and 5 to 10."""

import argparse
import json
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import say_written
from anser_ros.cli.progress import progress_of
from anser_ros.experiments.figures import draw_all
from anser_ros.experiments.recordings import (
    Recordings,
    default_folder,
    given_recordings,
    missing,
)
from anser_ros.experiments.report import write_report
from anser_ros.experiments.simulated import simulate_recordings
from anser_ros.experiments.study import Results, Study

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
    parser.add_argument(
        '--sessions',
        type=Path,
        help='folder of the recordings; by default the shared ones, or simulated',
    )
    parser.add_argument(
        '--out',
        type=Path,
        default=Path('out/paper'),
        help='folder for the report, made if missing',
    )
    parser.add_argument('--simulate', action='store_true', help='simulate the recordings anyway')
    parser.add_argument('--seed', type=int, default=1, help='seed of the simulated recordings')
    parser.add_argument('--json', action='store_true', help='print paper.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    make_folder(args.out)
    with progress_of('recordings') as tell, tempfile.TemporaryDirectory() as scratch:
        recordings = _recordings(args, Path(scratch))
        study = Study(recordings, tell)
        results = study.run()
        figures = draw_all(study, args.out)
    document = results.document()
    write_report(document, figures, args.out / 'paper.md')
    text = json.dumps(document, indent=1)
    (args.out / 'paper.json').write_text(text + '\n', encoding='utf-8')
    if args.json:
        print(text)
    else:
        Console().print(_table(results))
        say_written(args.out / 'paper.md', args.out / 'paper.json')
    return 0


def _recordings(args: argparse.Namespace, scratch: Path) -> Recordings:
    """Return the recordings asked for, the shared ones, or else ones simulated here."""
    if args.simulate:
        return simulate_recordings(scratch, args.seed)
    if args.sessions is not None:
        return given_recordings(args.sessions)
    folder = default_folder()
    if not missing(folder):
        return given_recordings(folder)
    return simulate_recordings(scratch, args.seed)


def _table(results: Results) -> Table:
    table = Table(title=f'position RMSE, mm; simulated data ({results.origin})')
    for name in ('experiment', 'method', 'Y', 'Z'):
        table.add_column(name)
    for experiment in SHOWN_TABLES:
        for method, errors in results.tracking[experiment].items():
            values = [f'{errors[s].millimetres()["RMSE"]:.3f}' for s in ('Y', 'Z')]
            table.add_row(experiment.replace('_', ' '), method, *values)
    return table
