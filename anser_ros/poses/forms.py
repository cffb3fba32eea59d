"""Reads files of poses as trackers and their programs write them into rows, nothing judged yet.

Four forms are told apart by their content: NDI ToolTracker's ``.tsv``; lines of ``Key: numbers``;
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

    Attributes
    ----------
    host, device : list of float
        Time of receipt and the device's own time, s; NaN where the form lacks it.
    values : list of tuple
        Position in the file's unit, and quaternion in the file's order; NaN for no pose.
    form : str
        How its quaternions are written, a key of `ORDERS`.
    unit : str
        Unit of its lengths, a key of `LENGTH_M`.
    """

    host: list[float] = field(default_factory=list)
    device: list[float] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)
    form: str = 'xyzw'
    unit: str = 'mm'


Reader = Callable[[Sequence[str], Path], tuple[dict[str, RawRows], int]]
"""What makes rows of lines, and tells of how many."""


@dataclass
class FormFile:
    """Holds what a file of poses contains.

    Attributes
    ----------
    rows : dict of str to RawRows
        By the sensor's name.
    unread : int
        Lines that hold no pose and no marker for one.
    """

    rows: dict[str, RawRows]
    unread: int = 0


def read_form(path: Path) -> FormFile:
    """Read a file of any known form; the rows of each sensor that it names.

    Lines before the first that has the form, such as a title, are left out.

    Raises
    ------
    ParameterError
        When no form fits, or the file has no row.
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
    if not any(one.values for one in rows.values()):
        raise ParameterError(f'{path}: no row that is a pose')
    return FormFile(rows, len(lines) - read)


def _reader(line: str) -> Reader | None:
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


def _tool_tracker(lines: Sequence[str], path: Path) -> tuple[dict[str, RawRows], int]:
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
            one.host.append(float('nan'))
            one.device.append(_number(port[1]) / rate)
            one.values.append(pose)
    return rows, read


def _keyed(lines: Sequence[str], path: Path) -> tuple[dict[str, RawRows], int]:
    """Lines such as ``SensorID: 0 Position: x y z Orientation: a b c d Time: ns``."""
    rows: dict[str, RawRows] = {}
    for line in lines:
        parts = {key: text.split() for key, text in _KEY.findall(line)}
        if len(parts.get('Position', ())) != 3 or len(parts.get('Orientation', ())) != 4:
            continue
        label = f'sensor_{parts["SensorID"][0]}' if 'SensorID' in parts else REFERENCE
        # Ascension's driver is the one that tells a quality and the time of the day.
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
        one.host.append(1e-9 * float(host))
        one.device.append(float(device))
        one.values.append(tuple(numbers))
    if not rows:
        raise ParameterError(f'{path}: no line with a position and an orientation')
    return rows, sum(len(one.values) for one in rows.values())


def _tum(lines: Sequence[str], path: Path) -> tuple[dict[str, RawRows], int]:
    """TUM: s, m, scalar last."""
    one = RawRows(unit='m')
    for line in lines:
        numbers = [_number(cell) for cell in re.split(r'[\s,]+', line.strip())]
        if len(numbers) < LEAST_COUNTED:
            raise ParameterError(f'{path}: a line of {len(numbers)} numbers, TUM has 8')
        one.host.append(numbers[0])
        one.device.append(float('nan'))
        one.values.append(tuple(numbers[1:8]))
    return {path.stem: one}, len(lines)


def _table(lines: Sequence[str], path: Path) -> tuple[dict[str, RawRows], int]:
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
        stamp = _number(row[clock] or '')
        one.host.append(1e-9 * stamp if clock == 'stamp_ns' else stamp)
        one.device.append(float('nan'))
        place = (_number(row[f'{axis}_{unit}'] or '') for axis in 'xyz')
        one.values.append((*place, *(_number(row[key] or '') for key in turn)))
    return rows, len(lines)
