"""Writes the document and tables that an evaluation leaves, and compares two of the same frames.

Frames close in time share the causes of their errors, so whole stretches of time are resampled
(the moving-block idea of Künsch, Annals of Statistics 17, 1989), all coils of a stretch together.
"""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, Integers
from anser_ros.errors import ParameterError
from anser_ros.fingerprint import fingerprint_of
from anser_ros.pose_states import OK
from anser_ros.sessions.session import Session
from anser_ros.sessions.tracked_session import Evaluation, PoseSeries, metrics
from anser_ros.wire.tables import Table, read_table
from anser_ros.wire.text_files import read_text

SCHEMA = 'anser_evaluation/1'
"""Name of the document's layout, which stands in every such document."""


def recording_of(session: Session) -> str:
    """Return the fingerprint of what was recorded, whatever the file is called."""
    return fingerprint_of([tool.flux[:, :1] for tool in session.tools])


def to_document(evaluation: Evaluation) -> dict[str, Any]:
    """Return the figures of every sensor and body, and of a refit, as plain data."""
    document: dict[str, Any] = {'schema': SCHEMA}
    for kind, group in evaluation.groups.items():
        document[kind] = {name: metrics(series) for name, series in group.items()}
    if evaluation.refit is not None:
        document['refit'] = {
            'states': dict(evaluation.refit.states),
            'left_out': dict(evaluation.refit.left_out),
        }
    return document


POSE_COLUMNS = (
    'stamp_ns', 'sensor', 'x_m', 'y_m', 'z_m', 'ax', 'ay', 'az', 'sigma_position_m', 'residual_t',
    'status',
)  # fmt: skip
"""Columns of the sensors' table; a coil's pose is its centre and its sensitive axis."""
BODY_COLUMNS = (
    'stamp_ns', 'body', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw', 'sigma_position_m',
    'residual_t', 'status',
)  # fmt: skip
"""Columns of the bodies' table; the orientation is a quaternion."""
POSES_FILE, BODIES_FILE, ERRORS_FILE = 'poses.csv', 'bodies.csv', 'errors.csv'
ERROR_COLUMNS = ('stamp_ns', 'name', 'position_error_m', 'orientation_error_rad')
"""Columns of the table of errors, of coils and bodies."""


def write_tables(folder: Path, evaluation: Evaluation) -> list[Path]:
    """Write the tables of poses, sensors' by stamp, and of errors into a folder; the files."""
    of_sensors = _pose_rows(evaluation.sensors, POSE_COLUMNS)
    tables = {
        POSES_FILE: (POSE_COLUMNS, sorted(of_sensors, key=itemgetter(0))),
        BODIES_FILE: (BODY_COLUMNS, _pose_rows(evaluation.bodies, BODY_COLUMNS)),
        ERRORS_FILE: (ERROR_COLUMNS, _error_rows(evaluation)),
        **{
            f'{kind}.csv': (POSE_COLUMNS, _pose_rows(group, POSE_COLUMNS))
            for kind, group in evaluation.further.items()
        },
    }
    for name, (columns, rows) in tables.items():
        with (folder / name).open('w', newline='', encoding='utf-8') as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            writer.writerows(rows)
    return [folder / name for name in tables]


def _error_rows(evaluation: Evaluation) -> list[list[Any]]:
    """The error of every pose that has an optical one."""
    return [
        [estimate.stamp_ns, series.name, f'{place:.9g}', f'{turn:.9g}']
        for group in evaluation.groups.values()
        for series in group.values()
        for estimate, place, turn in zip(
            series.estimates, series.position_error.tolist(), series.orientation_error.tolist(),
            strict=True,
        )
        if isfinite(place)
    ]  # fmt: skip


def _pose_rows(group: Mapping[str, PoseSeries], columns: Sequence[str]) -> list[list[Any]]:
    """Rows with an axis, or, in the columns of bodies, a quaternion; empty cells for no pose."""
    of_body, rows = columns is BODY_COLUMNS, []
    for series in group.values():
        for pose in series.estimates:
            cells = [''] * (len(columns) - 3)
            if pose.state == OK and not (of_body and pose.rotation is None):
                turn = Rotation.from_matrix(pose.rotation).as_quat() if of_body else pose.axis
                values = [*pose.position, *turn, pose.sigma_position_m, pose.residual_t]
                cells = [f'{float(value):.9g}' for value in values]
            rows.append([pose.stamp_ns, series.name, *cells, pose.state])
    return rows


Key = tuple[int, str]

BLOCK_NS = 1_000_000_000
"""Length of a stretch that is resampled as one, ns: errors of a second ago are hardly related."""
DRAWS = 2000
"""Resamples: the ends of a 95 % interval then vary by a few percent of its width."""
INTERVAL_SHARE = 0.95
"""Share of the resamples that lie in the interval, as is usual in the field's publications."""
FEWEST_BLOCKS = 5
"""Stretches below which an interval means nothing: its ends would be those of single ones."""


@dataclass(frozen=True)
class Compared:
    """Compares errors, m or rad, or shares of frames with a pose, 0 to 1, of one coil or body.

    ``low`` and ``high`` are the interval of the difference, second less first, NaN where stretches
    are too few. ``n`` frames are those of both; those that only one of the two has are counted.
    """

    low: float
    high: float
    n: int
    only_a: int
    only_b: int
    a: float  # root mean square error, or share
    b: float
    are_shares: bool

    @property
    def verdict(self) -> str:
        """Return which is better, ``a`` or ``b``; ``neither`` where both may be."""
        return {0: 'neither', 1 if self.are_shares else -1: 'b'}.get(self.sign, 'a')

    @property
    def sign(self) -> int:
        """Return the sign of the difference where the whole interval has one, else 0."""
        return int(self.low > 0) - int(self.high < 0)


def check_same_recording(first: Path, second: Path) -> None:
    """Raise `ParameterError` when two evaluations state that they are of different recordings."""
    one, two = _recording(first), _recording(second)
    if one and two and one != two:
        raise ParameterError(
            f'{first} and {second} are evaluations of two different recordings ({one}, {two}), '
            f'whose frames cannot be paired'
        )


def _recording(folder: Path) -> str:
    """What an evaluation says that it is of; empty where it does not, as older ones."""
    path = folder / 'evaluation.json'
    if not path.is_file():
        return ''
    try:
        return str(json.loads(read_text(path)).get('recording', ''))
    except (ValueError, AttributeError) as error:
        raise ParameterError(f'{path}: not a document of anser evaluate') from error


def read_errors(folder: Path) -> dict[str, dict[Key, float]]:
    """Return errors of position (m) and orientation (rad) by stamp and name; `ParameterError`."""
    keys, table = _read(folder, ERRORS_FILE, ERROR_COLUMNS)
    return {
        kind.partition('_')[0]: dict(zip(keys, table.array(kind).tolist(), strict=True))
        for kind in ERROR_COLUMNS[2:]
    }


def read_states(folder: Path) -> dict[Key, float]:
    """Return whether there is a pose, 1 or 0, by stamp and name; raises `ParameterError`."""
    found: dict[Key, float] = {}
    for name, columns in ((POSES_FILE, POSE_COLUMNS), (BODIES_FILE, BODY_COLUMNS)):
        keys, table = _read(folder, name, columns)
        found |= zip(keys, map(float, table.words('status') == OK), strict=True)
    return found


def _read(folder: Path, name: str, columns: tuple[str, ...]) -> tuple[list[Key], Table]:
    """A table, and the stamp and the name in its second column of each row."""
    path = folder / name
    if not path.is_file():
        raise ParameterError(f'{folder}: no {name}; is it a folder of anser evaluate?')
    table = read_table(path, as_text=True)
    if table.names != columns:
        raise ParameterError(f'{path}: columns must be {", ".join(columns)}')
    stamps = table.array('stamp_ns').tolist()
    return list(zip(stamps, table.words(columns[1]), strict=True)), table


def compare(
    first: Mapping[Key, float],
    second: Mapping[Key, float],
    rng: np.random.Generator,
    *,
    are_shares: bool = False,
) -> dict[str, Compared]:
    """Compare errors of one kind by stamp and name, or whether there is a pose (`read_states`).

    Raises `ParameterError` when no frame of whole sessions is in both.
    """
    if are_shares and not first.keys() & second.keys():
        raise ParameterError('the two have no frame in common: are they of the same session?')
    shown, found = np.asarray if are_shares else np.sqrt, {}
    for name in dict.fromkeys(name for _, name in (*first, *second)):
        one, two = ({t: v for (t, n), v in side.items() if n == name} for side in (first, second))
        both = sorted(one.keys() & two.keys())
        pairs = np.array([[side[stamp] for stamp in both] for side in (one, two)])
        pairs = pairs if are_shares else pairs**2
        low, high = _interval(np.array(both, dtype=np.int64), pairs, rng, shown)
        a, b = shown(pairs.mean(axis=1)).tolist() if both else (np.nan, np.nan)
        alone = len(one) - len(both), len(two) - len(both)
        found[name] = Compared(low, high, len(both), *alone, a, b, are_shares)
    return found


def _interval(
    stamps: Integers, values: Array, rng: np.random.Generator, shown: Callable[[Array], Array]
) -> tuple[float, float]:
    """The interval of the difference of two means, as they are shown, by resampled stretches."""
    if not stamps.size:
        return np.nan, np.nan
    _, block = np.unique((stamps - stamps[0]) // BLOCK_NS, return_inverse=True)
    count = int(block.max()) + 1
    if count < FEWEST_BLOCKS:
        return np.nan, np.nan
    sums = np.array([np.bincount(block, weights=row) for row in values])
    sizes = np.bincount(block)
    drawn = rng.integers(0, count, size=(DRAWS, count))
    means = sums[:, drawn].sum(axis=2) / sizes[drawn].sum(axis=1)
    difference = np.diff(shown(means), axis=0)[0]
    tail = 50.0 * (1.0 - INTERVAL_SHARE)
    low, high = np.percentile(difference, (tail, 100.0 - tail))
    return float(low), float(high)
