"""Learn an error map from tracked and true positions, and apply it to others."""

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from anser_ros.calibration.error_map import ErrorMap, learn_error_map
from anser_ros.cli.output import make_folder, say_written
from anser_ros.errors import FitError, ParameterError, PlausibilityError
from anser_ros.sessions.plausibility import check_points

SCHEMA = 'anser_error_map/1'
TRACKED = ('x_m', 'y_m', 'z_m')
TRUE = ('true_x_m', 'true_y_m', 'true_z_m')

Array = NDArray[np.float64]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        'points', type=Path, help=f'CSV with the columns {", ".join((*TRACKED, *TRUE))}'
    )
    parser.add_argument(
        '--out',
        required=True,
        type=Path,
        help='folder for error_map.json, made if missing',
    )
    parser.add_argument(
        '--apply', type=Path, metavar='POSES', help='CSV to correct, e.g. poses.csv of evaluate'
    )
    parser.add_argument('--json', action='store_true', help='print error_map.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    rows, _ = _read(args.points)
    make_folder(args.out)
    tracked, true = (_columns(rows, names, args.points) for names in (TRACKED, TRUE))
    try:
        check_points(tracked, true)
    except PlausibilityError as error:
        raise PlausibilityError(f'{args.points}: {error}') from error
    error_map = learn_error_map(tracked, true)
    if args.apply is not None:
        poses, names = _read(args.apply)
        corrected = error_map.apply(_columns(poses, TRACKED, args.apply))
    text = json.dumps(to_document(error_map), indent=1)
    (args.out / 'error_map.json').write_text(text + '\n', encoding='utf-8')
    if args.apply is not None:
        _write(args.out / 'corrected.csv', poses, names, corrected)
    if args.json:
        print(text)
    else:
        Console().print(
            f'{error_map.shape.describe()}: held out {1e3 * error_map.before_m:.3f} mm rms '
            f'without, {1e3 * error_map.after_m:.3f} mm with',
            highlight=False,
        )
        files = ['error_map.json'] + ([] if args.apply is None else ['corrected.csv'])
        say_written(*(args.out / name for name in files))
    return 0


def to_document(error_map: ErrorMap) -> dict[str, Any]:
    """Return the map and the figures of its choice as plain data."""
    return {
        'schema': SCHEMA,
        'map': error_map.shape.describe(),
        'heldout_rmse_before_m': error_map.before_m,
        'heldout_rmse_after_m': error_map.after_m,
        'n_points': error_map.n_points,
        'tried': [
            {'map': shape.describe(), 'noise_share': shape.noise, 'heldout_rmse_m': error}
            for shape, error in error_map.tried
        ],
    }


def _read(path: Path) -> tuple[list[dict[str, str]], list[str]]:
    with path.open(encoding='utf-8', newline='') as stream:
        reader = csv.DictReader(stream)
        rows = list(reader)
        names = list(reader.fieldnames or [])
    if not rows:
        raise FitError(f'{path}: no rows')
    return rows, names


def _columns(rows: list[dict[str, str]], names: tuple[str, ...], path: Path) -> Array:
    """Return columns as numbers, with NaN for an empty cell."""
    try:
        return np.array([[float(row[name] or 'nan') for name in names] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError(
            f'{path}: needs the columns {", ".join(names)} with numbers: {error}'
        ) from error


def _write(path: Path, rows: list[dict[str, str]], names: list[str], places: Array) -> None:
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        for row, place in zip(rows, places, strict=True):
            writer.writerow({**row, **dict(zip(TRACKED, place.tolist(), strict=True))})
