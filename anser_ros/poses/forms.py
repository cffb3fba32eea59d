"""Reads files of poses as trackers and their programs write them into rows, nothing judged yet.

Four forms are recognised by their content: NDI ToolTracker's ``.tsv``; lines of ``Key: numbers``;
TUM's ``t x y z qx qy qz qw``; and CSV with named columns.
"""

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ParameterError
from anser_ros.poses.sequence import REFERENCE
from anser_ros.sessions.units import LENGTH_M

Array = NDArray[np.float64]

ORDERS = {
    'xyzw': ((0, 1, 2, 3), False),
    'wxyz': ((1, 2, 3, 0), False),
    'xyzw_inverse': ((0, 1, 2, 3), True),
    'wxyz_inverse': ((1, 2, 3, 0), True),
}
"""Where x, y, z and w stand in a written quaternion, and whether it turns the other way."""
AURORA_HZ, POLARIS_HZ = 320.0, 60.0
"""Counts a second of the frame counters of NDI's Aurora (field periods) and Polaris (images)."""
COUNTERS = {'AuroraFrame': AURORA_HZ, 'PolarisFrame': POLARIS_HZ, 'DeviceTime': 1.0}
"""Keys of a device's own time, with its counts a second."""
HOST_TIMES = ('NetworkTime', 'Time')
"""Keys of the host's counter at receipt, ns."""
LEAST_COUNTED = 8
"""Numbers that a line of TUM's form has: the time, a position, a quaternion."""
TUM = re.compile(r'\s*[-+.\deE]+([\s,]+([-+.\deE]+|[-+]?nan|[-+]?inf)){7}', re.IGNORECASE)
"""A line of TUM's form; values that are no numbers stand where there was no pose."""
TITLE_LINES = 20  # lines that a program may write before its poses
PORT_COLUMNS = 13
"""Columns of a port in a ToolTracker file: name, frame, face, state, pose, error, markers."""
_KEY = re.compile(r'(\w+):\s*((?:[^\s:]+(?:\s+|$)(?!:))*?)(?=\s*\w+:|\s*$)')


@dataclass
class RawRows:
    """Holds rows of one sensor as they stand in a file, in the file's own units.

    Each row holds the time of receipt and the device's own time, s (NaN where the form lacks it),
    the position in the file's unit and the quaternion in the file's order; NaN for no pose.
    """

    rows: list[tuple[float, ...]] = field(default_factory=list)
    form: str = 'xyzw'  # how its quaternions are written, a key of `ORDERS`
    unit: str = 'mm'  # unit of its lengths, a key of `LENGTH_M`

    @property
    def table(self) -> Array:
        """Return the rows as an array, shape (n, 9)."""
        return np.array(self.rows, dtype=np.float64).reshape(-1, 9)


Found = tuple[dict[str, RawRows], int]
"""Rows by the sensor's name, and a number of lines."""


def read_form(path: Path) -> Found:
    """Read a file of any known form: its rows, and how many lines hold no pose and no marker.

    Lines before the first that has the form, such as a title, are left out.

    Raises `ParameterError` when no form fits, or the file has no row.
    """
    lines = path.read_text(encoding='utf-8-sig', errors='replace').splitlines()
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith('#')]
    if not lines:
        raise ParameterError(f'{path}: no rows')
    first, reader = next(
        ((i, r) for i, line in enumerate(lines[:TITLE_LINES]) if (r := _reader(line))),
        (0, _table),
    )
    rows, read = reader(lines[first:], path)
    if not any(one.rows for one in rows.values()):
        raise ParameterError(f'{path}: no row that is a pose')
    return rows, len(lines) - read


def _reader(line: str) -> Callable[[Sequence[str], Path], Found] | None:
    """What reads the form that a line is of, or None; a table's header has names of columns."""
    if line.startswith('Tools\t'):
        return _tool_tracker
    if 'Position:' in line:
        return _keyed
    if TUM.match(line):
        return _tum
    return _table if {'qx', 'qw'} <= set(line.strip().split(',')) else None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float('nan')


def _tool_tracker(lines: Sequence[str], path: Path) -> Found:
    """NDI ToolTracker: a group of columns a port; scalar first; states in words."""
    rows: dict[str, RawRows] = {}
    read = 0
    for line in lines:
        cells = line.split('\t')
        if cells[0] == 'Tools':  # once more where the program was started again
            read += 1
            continue
        read += len(cells) >= PORT_COLUMNS
        for start in range(1, len(cells), PORT_COLUMNS):
            port = cells[start : start + PORT_COLUMNS]
            if len(port) < PORT_COLUMNS - 1:
                continue
            label = re.sub(r'\W+', '_', port[0].split(':')[0].strip().lower())
            rate = POLARIS_HZ if 'OT' in port[0] else AURORA_HZ
            one = rows.setdefault(label, RawRows(form='wxyz'))
            numbers = [_number(cell) for cell in port[4:11]]
            good = port[3].strip() in ('OK', 'Partially Out of Volume')
            pose = (*numbers[4:7], *numbers[:4]) if good else (float('nan'),) * 7
            one.rows.append((float('nan'), _number(port[1]) / rate, *pose))
    return rows, read


def _keyed(lines: Sequence[str], path: Path) -> Found:
    """Lines such as ``SensorID: 0 Position: x y z Orientation: a b c d Time: ns``."""
    rows: dict[str, RawRows] = {}
    for line in lines:
        parts = {key: text.split() for key, text in _KEY.findall(line)}
        if len(parts.get('Position', ())) != 3 or len(parts.get('Orientation', ())) != 4:
            continue
        label = f'sensor_{parts["SensorID"][0]}' if 'SensorID' in parts else REFERENCE
        # Ascension's driver is the one that writes a quality and the time of the day.
        form = 'wxyz_inverse' if 'Quality' in parts else 'xyzw'
        one = rows.setdefault(label, RawRows(form=form))
        host = next((_number(parts[key][0]) for key in HOST_TIMES if parts.get(key)), np.nan)
        device = next(
            (_number(parts[key][0]) / rate for key, rate in COUNTERS.items() if parts.get(key)),
            np.nan,
        )
        numbers = [_number(cell) for cell in (*parts['Position'], *parts['Orientation'])]
        if 'State' in parts and parts['State'][:1] not in (['OK'], ['Partially']):
            numbers = [float('nan')] * 7
        one.rows.append((1e-9 * float(host), float(device), *numbers))
    if not rows:
        raise ParameterError(f'{path}: no line with a position and an orientation')
    return rows, sum(len(one.rows) for one in rows.values())


def _tum(lines: Sequence[str], path: Path) -> Found:
    """TUM: s, m, scalar last."""
    one = RawRows(unit='m')
    for line in lines:
        numbers = [_number(cell) for cell in re.split(r'[\s,]+', line.strip())]
        if len(numbers) < LEAST_COUNTED:
            raise ParameterError(f'{path}: a line of {len(numbers)} numbers, TUM has 8')
        one.rows.append((numbers[0], float('nan'), *numbers[1:8]))
    return {path.stem: one}, len(lines)


def _table(lines: Sequence[str], path: Path) -> Found:
    """CSV: ``stamp_ns`` or ``time_s``, positions with their unit, quaternions, ``sensor``."""
    reader = csv.DictReader(lines)
    names = reader.fieldnames or []
    unit = next((u for u in LENGTH_M if {f'{axis}_{u}' for axis in 'xyz'} <= set(names)), None)
    clock = next((c for c in ('stamp_ns', 'time_s') if c in names), None)
    turn = ('qx', 'qy', 'qz', 'qw')
    if unit is None or clock is None or not set(turn) <= set(names):
        raise ParameterError(
            f'{path}: no known form; a CSV needs the columns stamp_ns or time_s, x_m, y_m, z_m '
            f'(or _mm), qx, qy, qz, qw'
        )
    rows: dict[str, RawRows] = {}
    for row in reader:
        one = rows.setdefault(str(row.get('sensor') or path.stem), RawRows(unit=unit))
        stamp = _number(row[clock] or '') * (1e-9 if clock == 'stamp_ns' else 1.0)
        pose = (_number(row[key] or '') for key in (*(f'{axis}_{unit}' for axis in 'xyz'), *turn))
        one.rows.append((stamp, float('nan'), *pose))
    return rows, len(lines)
