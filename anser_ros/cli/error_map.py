"""Learn a correction of positions where true ones are known, and apply it to others."""

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from anser_ros.calibration.error_map import ErrorMap, HeldOutError, learn_error_map
from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import say_written
from anser_ros.cli.progress import progress_of
from anser_ros.errors import FitError, ParameterError, PlausibilityError
from anser_ros.poses.point_model import to_point_model
from anser_ros.sessions.plausibility import check_points
from anser_ros.wire.fiducials import read_fiducials
from anser_ros.wire.text_files import numbers_of, read_rows

SCHEMA = 'anser_error_map/1'
TRACKED = ('x_m', 'y_m', 'z_m')
TRUE = ('true_x_m', 'true_y_m', 'true_z_m')
MARKUPS = '.fcsv'

Array = NDArray[np.float64]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser error_map examples/data/points.csv --out map/; with lists of points: '
        'anser error_map tracked.fcsv --true board.csv --register --out map/'
    )
    parser.add_argument(
        'points', type=Path,
        help=f'CSV with the columns {", ".join((*TRACKED, *TRUE))}; or, with --true, tracked '
        f'positions: a CSV with {", ".join(TRACKED)}, or a list of 3D Slicer ({MARKUPS}, mm)',
    )  # fmt: skip
    parser.add_argument(
        '--true',
        type=Path,
        metavar='PLACES',
        help='the true positions, one row per tracked position',
    )
    parser.add_argument(
        '--register', action='store_true',
        help='the true positions are in another frame: a shift and a rotation between both are '
        'not counted as errors',
    )  # fmt: skip
    parser.add_argument(
        '--out',
        required=True,
        type=Path,
        help='folder for error_map.json and model.yaml, made if missing',
    )
    parser.add_argument(
        '--sensor', default='sensor', help='name of the sensor whose poses the model corrects'
    )
    parser.add_argument(
        '--apply', type=Path, metavar='POSES', help='CSV to correct, e.g. poses.csv of evaluate'
    )
    parser.add_argument('--json', action='store_true', help='print error_map.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    make_folder(args.out)
    tracked, true = _points(args)
    try:
        check_points(tracked, true)
    except PlausibilityError as error:
        raise PlausibilityError(f'{args.points}: {error}') from error
    with progress_of('learning') as tell:
        tell(f'a map of {len(tracked)} places')
        error_map = learn_error_map(tracked, true, registers=args.register)
    if args.apply is not None:
        poses, names = _read(args.apply)
        places = _numbers(args.apply, poses, TRACKED)
        corrected = error_map.apply(places) if error_map.is_confirmed else places
    text = json.dumps(to_document(error_map), indent=1)
    (args.out / 'error_map.json').write_text(text + '\n', encoding='utf-8')
    model = to_point_model(error_map, args.sensor, str(args.points))
    text_of_model = yaml.safe_dump(model, sort_keys=False)
    (args.out / 'model.yaml').write_text(text_of_model, encoding='utf-8')
    if args.apply is not None:
        _write(args.out / 'corrected.csv', poses, names, corrected)
    if args.json:
        print(text)
    else:
        print(verdict(error_map))
        files = ['error_map.json', 'model.yaml'] + (
            [] if args.apply is None else ['corrected.csv']
        )
        say_written(*(args.out / name for name in files))
    return 0


def verdict(error_map: ErrorMap) -> str:
    """State in a line what places that took no part say of the map."""
    before, after = 1e3 * error_map.before_m, 1e3 * error_map.after_m
    along = 'in the plane of the places, ' if error_map.before.in_plane is not None else ''
    figures = f'held out, {along}{before:.3f} mm rms without a map, {after:.3f} mm with'
    if error_map.is_confirmed:
        return f'{error_map.shape.describe()}: {figures}'
    if not error_map.helps:
        return f'no map helps: {figures}, so nothing is corrected'
    return (
        f'{error_map.shape.describe()}: no gain is shown: {figures} '
        f'({error_map.clearness:+.1f} standard errors), so nothing is corrected'
    )


def _points(args: argparse.Namespace) -> tuple[Array, Array]:
    """Tracked and true positions, m."""
    if args.true is None:
        if args.points.suffix == MARKUPS:
            raise ParameterError(f'{args.points} has tracked positions only; --true is needed')
        rows, _ = _read(args.points)
        return _numbers(args.points, rows, TRACKED), _numbers(args.points, rows, TRUE)
    tracked, true = (
        read_fiducials(path) if path.suffix == MARKUPS else _numbers(path, _read(path)[0], TRACKED)
        for path in (args.points, args.true)
    )
    if len(tracked) != len(true):
        raise ParameterError(
            f'{args.points} has {len(tracked)} positions and {args.true} {len(true)}; '
            'they belong together row by row'
        )
    return tracked, true


def to_document(error_map: ErrorMap) -> dict[str, Any]:
    """Return the map and the figures of its choice as plain data."""
    return {
        'schema': SCHEMA,
        'map': error_map.shape.describe(),
        'confirmed': error_map.is_confirmed,
        'clearness': error_map.clearness,
        'heldout_rmse_before_m': error_map.before_m,
        'heldout_rmse_after_m': error_map.after_m,
        'before': _plain(error_map.before),
        'after': _plain(error_map.after),
        'n_points': error_map.n_points,
        'tried': [
            {'map': shape.describe(), 'noise_share': shape.noise, 'heldout_rmse_m': error}
            for shape, error in error_map.tried
        ],
    }


def _plain(error: HeldOutError) -> dict[str, float | None]:
    return {
        'rmse_m': error.whole,
        'in_plane_rmse_m': error.in_plane,
        'out_of_plane_rmse_m': error.out_of_plane,
    }


def _read(path: Path) -> tuple[list[dict[str, str]], list[str]]:
    names, rows = read_rows(path)
    if not rows:
        raise FitError(f'{path}: no rows')
    return rows, names


def _numbers(path: Path, rows: list[dict[str, str]], names: tuple[str, ...]) -> Array:
    return numbers_of(path, rows, names, with_gaps=True)


def _write(path: Path, rows: list[dict[str, str]], names: list[str], places: Array) -> None:
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        for row, place in zip(rows, places, strict=True):
            writer.writerow({**row, **dict(zip(TRACKED, place.tolist(), strict=True))})
