"""Analyses other people's measurements and compares errors before and after."""

import argparse
import contextlib
import io
import math
import os
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from anser_ros.apps.lab.measured import anser_board, hpi_coils, ilemt, magnet_patch, navion
from anser_ros.apps.lab.measured.recipe import SHARED, Recipe, ReportRow, shared_folder
from anser_ros.cli import main
from anser_ros.cli.output import Result, add_json, add_out, make_folder, say, write_files
from anser_ros.errors import ParameterError

RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        navion.RECIPE, magnet_patch.RECIPE, magnet_patch.STEP_RECIPE, hpi_coils.RECIPE,
        anser_board.RECIPE, ilemt.RECIPE,
    )
}  # fmt: skip
"""Data sets that the shipped commands are run on."""
SCHEMA = 'anser_measured/1'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = 'example: anser measured anser_board --out measured/'
    words = f'some of {", ".join(RECIPES)}; all by default'
    parser.add_argument('datasets', nargs='*', metavar='DATASET', help=words)
    words = f'folder with measured/ (${SHARED}, or ../shared of the source)'
    parser.add_argument('--shared', type=Path, help=words)
    add_out(parser, 'measured.json and what the commands write', required=False)
    words = 'folder for sessions of the data, made if missing'
    parser.add_argument('--bags', type=Path, help=words)
    add_json(parser, 'measured.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    wrong = [name for name in args.datasets if name not in RECIPES]
    if wrong:
        raise ParameterError(f'no data set {wrong[0]!r}; there are {", ".join(RECIPES)}')
    shared = args.shared or shared_folder()
    if not (shared / 'measured').is_dir():
        raise ParameterError(f'no measured data: {shared} has no folder measured; use --shared')
    console = Console(stderr=args.json, width=None if os.isatty(1) else 200)
    make_folder(args.out)
    make_folder(args.bags)
    names = args.datasets or _present(shared, console)
    if args.bags is not None:
        for name in names:
            for path in RECIPES[name].write_sessions(RECIPES[name].data(shared), args.bags):
                console.print(f'wrote {path}', highlight=False)
    rows = [row for name in names for row in _cook(RECIPES[name], shared, args, console)]
    document = to_document(rows)
    write_files(args.out, {'measured.json': document})
    written = () if args.out is None else (args.out,)
    if not args.json:
        console.print(table(rows))
    say('measured', Result(document, written=written), as_json=args.json)
    return 0


def _present(shared: Path, console: Console) -> list[str]:
    """The data sets whose folders are there; says of the others that they are left out."""
    folders = {name: recipe.data(shared) for name, recipe in RECIPES.items()}
    for name, folder in folders.items():
        if not folder.is_dir():
            console.print(f'{name} left out: no {folder}', highlight=False)
    return [name for name, folder in folders.items() if folder.is_dir()]


def _cook(
    recipe: Recipe, shared: Path, args: argparse.Namespace, console: Console
) -> list[ReportRow]:
    """Run a recipe's commands; the figures that they give."""
    folder = recipe.data(shared)
    with tempfile.TemporaryDirectory(prefix='anser_measured_') as made:
        out = Path(made) if args.out is None else args.out / recipe.name
        make_folder(out)
        bags = recipe.write_sessions(folder, Path(made) / 'bags')
        for command in recipe.commands(bags, out):
            console.print(f'$ anser {" ".join(command)}', highlight=False, soft_wrap=True)
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                code = main.main(command)
            if code:
                last = (printed.getvalue().strip().splitlines() or ['nothing said'])[-1]
                words = f'anser {command[0]} ended with {code}: {last}'
                raise ParameterError(f'{recipe.name}: {words}')
        return recipe.rows(folder, bags, out)


def to_document(rows: list[ReportRow]) -> dict[str, Any]:
    """Return the rows as plain data, with null for a missing number."""

    def plain(value: Any) -> Any:
        if isinstance(value, float | np.floating):
            return float(value) if math.isfinite(value) else None
        return value

    return {
        'schema': SCHEMA,
        'rows': [
            {
                'name': f'{row.dataset}: {row.figure}',
                **{key: plain(value) for key, value in asdict(row).items()},
            }
            for row in rows
        ],
    }


def table(rows: list[ReportRow]) -> Table:
    """Return the rows as a table for the terminal."""
    out = Table(title='Measured data: before and after, on held-out data')
    figures = ('before', 'after', 'special', 'target')
    for heading in ('data set', 'figure', *figures, 'met', 'chosen on'):
        out.add_column(heading, justify='right' if heading in figures else 'left', overflow='fold')
    for row in rows:
        met = {None: '', True: 'yes', False: 'no'}[row.met]
        given = (row.before, row.after, row.special, row.target)
        values = (math.nan if value is None else value for value in given)
        shown = ['' if math.isnan(v) else f'{v:.3g} {row.unit}'.strip() for v in values]
        out.add_row(row.dataset, row.figure, *shown, met, row.chosen_on)
    return out
