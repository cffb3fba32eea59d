"""Runs commands on sessions: which kind one is, several of them alone, and their summary."""

import argparse
import csv
import importlib
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from rich.table import Table

from anser_ros.cli import output
from anser_ros.cli.commands import SESSION_KINDS
from anser_ros.cli.main import EXIT_BAD_INPUT, EXIT_DEFECT, EXIT_OK, attempt
from anser_ros.cli.output import Result, Tell, loss_notes, make_folder, number, stated_values
from anser_ros.cli.page import Html, escaped, page, paragraph, table, top
from anser_ros.errors import ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import DEGREES
from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.starting_model import SNAPSHOT, is_snapshot, model_for


def add_session_options(
    parser: argparse.ArgumentParser, verb: str, file: str, idle: str = ''
) -> None:
    """Declare sessions, what they are taken with and where their results go, and an option for
    each kind of session with its own; ``idle`` is a value without effect, not to state.
    """
    words = f'bags to {verb} (.mcap files or bag folders)'
    parser.add_argument('sessions', nargs='+', metavar='BAG', help=words)
    output.add_out(parser, RESULTS)
    output.add_json(parser, f'{file}, or the summary, on stdout')
    parser.add_argument('--model', help="model file, or 'nominal' for the setup's own geometry")
    parser.add_argument('--baseline', help='distortion-free recording of the same board')
    output.add_list(
        parser, '--resurveyed', metavar='BODY',
        help='the sensors on BODY are those of the model, and were surveyed again: their '
        'channels are corrected as the model says, and their places and axes are those of '
        'the session; may be repeated',
    )  # fmt: skip
    output.add_stated_values(parser, 'accuracy', 'refit', 'tools', idle=idle)
    for name, (module, line) in SESSION_KINDS.items():
        parser.add_argument(f'--{name}', action='store_true', help=line)
        importlib.import_module(module).add_options(parser)


def named_kind(args: argparse.Namespace) -> ModuleType | None:
    """Return the module of the kind of session that the options name, None for one of fluxes.

    Raises `ParameterError` for an option that has no effect there.
    """
    chosen = None
    for name, (module, _) in SESSION_KINDS.items():
        kind = importlib.import_module(module)
        if getattr(args, name):
            chosen = kind
            continue
        for option, key in kind.OPTIONS.items():
            if getattr(args, key, None):
                raise ParameterError(f'--{option} has no effect without --{name}')
    return chosen


def given(
    args: argparse.Namespace, idle: Iterable[str], option: str
) -> tuple[Session, FieldModel, Session | None, tuple[str, ...]]:
    """Load a session, with what is stated of it, its model and its baseline; make the folder.

    Last comes what users have to know of them. Raises `ParameterError` without a model, or where a
    value is stated that is ``idle`` without an ``option``.
    """
    if args.model is None:
        kinds = ', '.join(f'--{name}' for name in SESSION_KINDS)
        raise ParameterError(f'the following arguments are required: --model (or {kinds})')
    session = load_session(args.session).with_stated(stated_values(args, idle, option))
    model = model_for(args.model, session, snapshot=True, resurveyed=args.resurveyed)
    baseline = load_session(args.baseline) if args.baseline else None
    make_folder(args.out)
    notes = *snapshot_notes(args.model, model), *loss_notes(session, baseline)
    return session, model, baseline, notes


def snapshot_notes(name: str, model: FieldModel) -> tuple[str, ...]:
    """Report that a command works with a snapshot of a refit, where it does."""
    return (f'{name} is a {SNAPSHOT}, not a calibration',) if is_snapshot(model) else ()


SCHEMA = 'anser_summary/1'
"""Name of the layout of what ``--json`` prints."""
WIDE = 'body { max-width: 90em } td, th { padding: .25em .5em }'
"""Style of a page whose table has many columns."""
FILES = ('summary.csv', 'summary.html')
RESULTS = (
    f'the results; of several sessions each has a folder in it, with {" and ".join(FILES)} beside'
)
MM, DEG, PT, PERCENT = 1e3, DEGREES, 1e12, 1e2
"""Factors from SI to the units of the table: mm a metre, degrees a radian, pT a tesla, percent."""

Row = dict[str, Any]


class Outcome(NamedTuple):
    """What a command left of one session."""

    name: str  # the session's in the summary, and of its folder
    session: str  # the bag
    code: int  # the exit code that the command alone would have had
    document: dict[str, Any]  # of its JSON file; empty where it failed
    words: str  # why it failed, or what users have to know, in one line
    traceback: str = ''  # of a defect
    seconds: float = 0.0  # duration


class Column(NamedTuple):
    """A figure: its key, in SI units, its heading, and the factor to the unit of the heading."""

    key: str
    heading: str
    scale: float = 1.0
    is_short: bool = False  # whether the table on the terminal has it too


EVALUATION = (
    Column('n_sensors', 'coils'),
    Column('n', 'poses compared'),
    Column('tracked_fraction', 'tracked %', PERCENT, is_short=True),
    Column('position_rmse_m', 'RMSE mm', MM, is_short=True),
    Column('worst_position_rmse_m', 'worst coil mm', MM, is_short=True),
    Column('orientation_rmse_rad', 'RMSE deg', DEG, is_short=True),
    Column('worst_orientation_rmse_rad', 'worst coil deg', DEG),
    Column('n_bodies', 'bodies'),
    Column('body_tracked_fraction', 'bodies tracked %', PERCENT),
    Column('body_position_rmse_m', 'bodies mm', MM, is_short=True),
    Column('body_orientation_rmse_rad', 'bodies deg', DEG),
)
DIAGNOSIS = (
    Column('effects', 'effects', is_short=True),
    Column('flux_rms_before_t', 'flux pT, before', PT, is_short=True),
    Column('flux_rms_after_t', 'after', PT, is_short=True),
    Column('flux_rms_floor_t', 'floor', PT),
    Column('position_rmse_before_m', 'mm, before', MM, is_short=True),
    Column('position_rmse_after_m', 'after', MM, is_short=True),
    Column('orientation_rmse_before_rad', 'deg, before', DEG),
    Column('orientation_rmse_after_rad', 'after', DEG),
    Column('unexplained_fraction', 'unexplained %', PERCENT),
)


def _evaluation(document: Mapping[str, Any]) -> Row:
    row: Row = {}
    for prefix, group in (('', 'sensors'), ('body_', 'bodies')):
        rows = list(document[group].values())
        row[f'n_{group}'] = len(rows)
        if not prefix:
            row['n'] = sum(one['n'] for one in rows)
        if not rows:
            continue
        shares = [one['tracked_fraction'] for one in rows]
        row[f'{prefix}tracked_fraction'] = sum(shares) / len(shares)
        for key in ('position_rmse_m', 'orientation_rmse_rad'):
            pairs = [(one['n'], one[key]) for one in rows if one[key] is not None]
            if pairs:
                mean = sum(n * root**2 for n, root in pairs) / sum(n for n, _ in pairs)
                row[f'{prefix}{key}'] = math.sqrt(mean)
                row[f'worst_{prefix}{key}'] = max(root for _, root in pairs)
    return row


def _diagnosis(document: Mapping[str, Any]) -> Row:
    names = ' '.join(dict.fromkeys(one['name'] for one in document['effects']))
    fraction = document['unexplained']['fraction']
    return {**document['held_out'], 'effects': names, 'unexplained_fraction': fraction}


COMMANDS: dict[str, tuple[tuple[Column, ...], Callable[[Mapping[str, Any]], Row], str]] = {
    'diagnose': (DIAGNOSIS, _diagnosis, 'report.html'),
    'evaluate': (EVALUATION, _evaluation, 'evaluation.html'),
}
"""Of each command its columns, how its document becomes a row, and its file to look at."""


def row_of(command: str, outcome: Outcome) -> Row:
    """Return a session as plain data, in SI units; None where a session has no such figure."""
    columns, figures, _ = COMMANDS[command]
    found = figures(outcome.document) if outcome.document else {}
    return {
        'session': outcome.session,
        'name': outcome.name,
        'status': 'failed' if outcome.code else 'ok',
        'message': outcome.words,
        'seconds': round(outcome.seconds, 3),
        **{column.key: found.get(column.key) for column in columns},
    }


def write_summary(folder: Path, command: str, rows: Sequence[Row]) -> tuple[Path, ...]:
    """Write the rows as CSV (SI units) and as a page, and return their paths."""
    with (folder / FILES[0]).open('w', encoding='utf-8', newline='') as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (folder / FILES[1]).write_text(_page(command, folder, rows), encoding='utf-8')
    return tuple(folder / name for name in FILES)


def table_of(command: str, rows: Sequence[Row]) -> Table:
    """Return the names and most important figures for a terminal of 80 columns."""
    columns = [column for column in COMMANDS[command][0] if column.is_short]
    shown = Table('session', *(column.heading for column in columns))
    failed = [row for row in rows if row['status'] != 'ok']
    for row in rows:
        if row['status'] == 'ok':
            shown.add_row(row['name'], *(_text(column, row) for column in columns))
        else:
            shown.add_row(row['name'], 'failed', style='red')
    if failed:
        shown.caption = f'{len(failed)} of {len(rows)} sessions failed'
    return shown


def _text(column: Column, row: Row) -> str:
    value = row[column.key]
    if isinstance(value, str):
        return value.replace(' ', '\n')
    return str(value) if isinstance(value, int) else number(value, column.scale, '.4g')


def _page(command: str, folder: Path, rows: Sequence[Row]) -> str:
    columns, _, file = COMMANDS[command]
    failed = sum(row['status'] != 'ok' for row in rows)
    lines = []
    for row in rows:
        name = escaped(row['name'])
        if (folder / row['name'] / file).is_file():
            name = Html(f'<a href="{name}/{file}">{name}</a>')
        cells = [_text(column, row) for column in columns]
        if row['status'] != 'ok':
            cells = ['failed', *('' for _ in cells[1:])]
        lines.append([
            Html(f'<span title="{escaped(row["session"])}">{name}</span>'), *cells,
            f'{row["seconds"]:.1f}', row['message'],
        ])  # fmt: skip
    words = f'{len(rows)} sessions, {failed} of them failed.'
    return page(
        f'anser {command}: summary',
        top(f'anser {command}', words if failed else f'{len(rows)} sessions.'),
        table(['session', *(column.heading for column in columns), 's', 'notes'], lines),
        paragraph('The same in SI units: summary.csv.', 'note'),
        style=WIDE,
    )


def names_of(sessions: Sequence[str]) -> list[str]:
    """Return names for sessions by their paths: as many last parts as distinguish them.

    Raises `ParameterError` when a session is given twice.
    """
    paths = [Path(session).resolve() for session in sessions]
    for place, path in enumerate(paths):
        if path in paths[:place]:
            raise ParameterError(f'{sessions[place]} is given twice')
    parts = [(*path.parts[1:-1], path.name if path.is_dir() else path.stem) for path in paths]
    names = []
    for own in parts:
        count = 1
        while sum(other[-count:] == own[-count:] for other in parts) > 1 and count < len(own):
            count += 1
        names.append('-'.join(own[-count:]))
    doubled = {name for name in names if names.count(name) > 1}
    return [
        path.name if name in doubled else name for name, path in zip(names, paths, strict=True)
    ]


Work = Callable[[argparse.Namespace, Tell], Result]
"""The work of a command on the ``session`` of its arguments, into their folder ``out``."""


def on_each(command: str, work: Work, args: argparse.Namespace, tell: Tell) -> Result:
    """Do a command's work on the only session of its arguments, or on one after the other.

    Of several each has a folder of its own, whatever comes of the others, and a row in a summary.
    """
    if kind := named_kind(args):
        work = getattr(kind, command)
    if len(args.sessions) == 1:
        args.session = args.sessions[0]
        return work(args, tell)
    names = names_of(args.sessions)
    make_folder(args.out)
    outcomes = []
    for count, (session, name) in enumerate(zip(args.sessions, names, strict=True)):
        tell(command, count / len(names))
        own = argparse.Namespace(**{**vars(args), 'session': session, 'out': args.out / name})
        outcomes.append(_outcome(name, work, own))
    return summed_up(command, outcomes, args.out)


def _outcome(name: str, work: Work, args: argparse.Namespace) -> Outcome:
    """What comes of one of several sessions."""
    began_s = time.monotonic()
    code, result, words = attempt(lambda: work(args, lambda *_: None))
    seconds = time.monotonic() - began_s
    if result is not None:
        notes = '; '.join(result.notes)
        return Outcome(name, args.session, code, result.document, notes, '', seconds)
    trace = words if code == EXIT_DEFECT else ''
    line = f'a defect of the program: {words.splitlines()[-1]}' if trace else words
    return Outcome(name, args.session, code, {}, line, trace, seconds)


def summed_up(command: str, outcomes: Sequence[Outcome], folder: Path) -> Result:
    """Write the summary of all runs of a command into a folder.

    The exit code is 0 where all went well, 1 where there was a defect of the program, else 2.
    """
    rows = [row_of(command, outcome) for outcome in outcomes]
    make_folder(folder)
    written = write_summary(folder, command, rows)
    failed = [outcome for outcome in outcomes if outcome.code != EXIT_OK]
    notes = [f'{one.session}:\n{one.traceback}' for one in failed if one.traceback]
    notes += [f'{one.name}: {one.words}' for one in failed]
    if failed:
        notes.append(f'{len(failed)} of {len(outcomes)} sessions failed')
    code = EXIT_BAD_INPUT if failed else EXIT_OK
    if EXIT_DEFECT in [one.code for one in failed]:
        code = EXIT_DEFECT
    document = {'schema': SCHEMA, 'command': command, 'sessions': rows}
    return Result(document, tuple(notes), (table_of(command, rows),), written, code)
