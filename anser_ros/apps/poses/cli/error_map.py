"""Learn a correction of positions where true ones are known, and apply it to others."""

import argparse
from pathlib import Path
from typing import Any

import yaml

from anser_ros.apps.poses.corrector import to_point_model
from anser_ros.arrays import Array
from anser_ros.calibration.error_map import ErrorMap, HeldOutError, learn_error_map
from anser_ros.cli.output import Result, Tell, add_json, add_out, make_folder, write_files
from anser_ros.errors import ParameterError, PlausibilityError
from anser_ros.sessions.plausibility import check_points
from anser_ros.wire.tables import MARKUPS, read_points, read_table

SCHEMA = 'anser_error_map/1'
TRACKED = ('x_m', 'y_m', 'z_m')
TRUE = ('true_x_m', 'true_y_m', 'true_z_m')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser error_map examples/data/points.csv --out map/; with lists of points: '
        'anser error_map tracked.fcsv --true board.csv --register --out map/'
    )
    parser.add_argument(
        'points', type=Path,
        help=f'CSV with the columns {", ".join((*TRACKED, *TRUE))}; or, with --true, tracked '
        f'positions: a CSV with {", ".join(TRACKED)}, or a list of 3D Slicer '
        f'({", ".join(MARKUPS)})',
    )  # fmt: skip
    words = 'the true positions, one row per tracked position'
    parser.add_argument('--true', type=Path, metavar='PLACES', help=words)
    parser.add_argument(
        '--register', action='store_true',
        help='the true positions are in another frame: a shift and a rotation between both are '
        'not counted as errors',
    )  # fmt: skip
    add_out(parser, 'error_map.json and model.yaml')
    parser.add_argument(
        '--sensor', default='sensor', help='name of the sensor whose poses the model corrects'
    )
    parser.add_argument(
        '--apply', type=Path, metavar='POSES', help='CSV to correct, e.g. poses.csv of evaluate'
    )
    add_json(parser, 'error_map.json on stdout')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Learn a map, and correct the poses of ``--apply``."""
    make_folder(args.out)
    tracked, true = _points(args)
    try:
        check_points(tracked, true)
    except PlausibilityError as error:
        raise PlausibilityError(f'{args.points}: {error}') from error
    tell(f'a map of {len(tracked)} places')
    error_map = learn_error_map(tracked, true, registers=args.register)
    if args.apply is not None:
        poses = read_table(args.apply, as_text=True)
        places = poses.numbers(TRACKED, with_gaps=True)
        corrected = error_map.apply(places) if error_map.is_confirmed else places
    document = to_document(error_map)
    model = yaml.safe_dump(
        to_point_model(error_map, args.sensor, str(args.points)), sort_keys=False
    )
    written = write_files(args.out, {'error_map.json': document, 'model.yaml': model})
    if args.apply is not None:
        written = (*written, args.out / 'corrected.csv')
        cells = poses.cells.assign(**dict(zip(TRACKED, corrected.T, strict=True)))
        cells.to_csv(written[-1], index=False, na_rep='nan')
    return Result(document, (), (verdict(error_map),), written)


def verdict(error_map: ErrorMap) -> str:
    """State in a line what places that took no part say of the map."""
    before, after = 1e3 * error_map.before.judged, 1e3 * error_map.after.judged
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
        if args.points.name.endswith(MARKUPS):
            raise ParameterError(f'{args.points} has tracked positions only; --true is needed')
        table = read_table(args.points)
        return table.positions(with_gaps=True), table.positions('true', with_gaps=True)
    tracked, true = map(read_points, (args.points, args.true))
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
        'heldout_rmse_before_m': error_map.before.judged,
        'heldout_rmse_after_m': error_map.after.judged,
        'before': _errors(error_map.before),
        'after': _errors(error_map.after),
        'n_points': len(error_map.places),
        'tried': [
            {'map': shape.describe(), 'noise_share': shape.noise, 'heldout_rmse_m': error}
            for shape, error in error_map.tried
        ],
    }


def _errors(error: HeldOutError) -> dict[str, float | None]:
    return {
        'rmse_m': error.whole,
        'in_plane_rmse_m': error.in_plane,
        'out_of_plane_rmse_m': error.out_of_plane,
    }
