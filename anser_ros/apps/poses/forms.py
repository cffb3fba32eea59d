"""Reads files of poses in the forms that trackers write: rows by sensor, as they stand there."""

import contextlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.sequence import REFERENCE
from anser_ros.arrays import Array, Booleans
from anser_ros.errors import ParameterError
from anser_ros.physics.rotations import nearest_rotation
from anser_ros.sessions.table_import import SCHEMA
from anser_ros.stamps import NANO, RECENT_NS, SECOND_NS
from anser_ros.wire import recorded
from anser_ros.wire.table_names import TIME_NS, UNITS, meaning_of, pose_columns, words_of
from anser_ros.wire.tables import Table, check_rising, read_table
from anser_ros.wire.text_files import read_text

ORDERS = {
    'xyzw': ((0, 1, 2, 3), 1.0),
    'wxyz': ((1, 2, 3, 0), 1.0),
    'xyzw_inverse': ((0, 1, 2, 3), -1.0),
    'wxyz_inverse': ((1, 2, 3, 0), -1.0),
}
"""Where x, y, z and w stand in a written quaternion, and the sense in which it turns."""
AURORA_HZ, POLARIS_HZ = 320.0, 60.0
"""Counts a second of the frame counters of NDI's Aurora (field periods) and Polaris (images)."""
COUNTERS = {'AuroraFrame': AURORA_HZ, 'PolarisFrame': POLARIS_HZ, 'DeviceTime': 1.0}
"""Keys of a device's own time, with its counts a second."""
HOST_TIMES = ('NetworkTime', 'Time')
"""Keys of the host's counter at receipt, ns."""
TUM = ('time_s', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw')
"""Columns of a table without names: those of TUM."""
LABELS = ('sensor', 'body', 'tool', 'name', 'sensor_id', 'tool_id', 'handle', 'port')
"""Columns that say of whom a row is."""
NO_POSE = (
    ({'valid', 'visible', 'tracked'}, '0(.0*)?|false|no'),
    ({'state', 'status'}, '(missing|lost|invalid|disabled|out|not|no|bad).*'),
)
"""Words of columns that say whether a row is a pose, and what stands in them where it is none."""
MOST_FALLS = 0.1  # share of times before the one above them from which a column is no time
FARTHEST_M = 3.0
"""Median distance, m, from which on positions without a stated unit are not in metres."""
SHORTEST_INTERVAL_S, LONGEST_INTERVAL_S = 1e-5, 2.0
"""Intervals of a tracker's poses, s: outside them times without a stated unit are no seconds."""
UNITS_OF_TIME = ((9e17, 2.2e18, 'ns'), (9e14, 2.2e15, 'us'), (9e11, 2.2e12, 'ms'))
"""What numbers must be whose name states no unit, by their range, if they count since 1970."""
TITLE_LINES = 20  # lines that a program may write before its poses
PORT_COLUMNS = 13
"""Columns of a port in a ToolTracker file: name, frame, face, state, pose, error, markers."""
PLUS = ('.mha', '.mhd', '.nrrd')
_PLUS_FIELD = re.compile(r'^Seq_Frame(\d+)_(\w+?)\s*:?=\s*(.*?)\s*$', re.MULTILINE)
_NO_COLON = re.compile(r'^\s*(\w+)(?=\s+\S+\s+\w+:)')
_KEY = re.compile(r'(\w+):\s*((?:[^\s:]+(?:\s+|$)(?!:))*?)(?=\s*\w+:|\s*$)')


@dataclass
class RawRows:
    """Holds rows of one sensor as they stand in a file, in the file's own units.

    Each row holds the time of receipt and the device's own time, s (NaN where the form lacks it),
    the position in the file's unit and the quaternion in the file's order; NaN for no pose.
    """

    rows: list[tuple[float, ...]] = field(default_factory=list)
    form: str = 'xyzw'  # how its quaternions are written, a key of `ORDERS`
    unit: str = 'mm'  # unit of its lengths, a key of `LENGTH_M`; empty where it is not stated
    assumed_hz: float = 0.0  # counts a second of a device that does not say what it is

    @property
    def table(self) -> Array:
        """Return the rows as an array, shape (n, 9)."""
        return np.array(self.rows, dtype=np.float64).reshape(-1, 9)


Found = tuple[dict[str, RawRows], int]
"""Rows by the sensor's name, and a number of lines."""


def read_form(path: Path, unit: str | None = None) -> Found:
    """Read a file of any known form: its rows, and how many lines hold no pose and no marker.

    Lines before the first that has the form, such as a title, are left out. Raises
    `ParameterError` when no form fits, a header states another ``unit``, or the file has no row.
    """
    if path.suffix.lower() in PLUS:
        return _plus(path), 0
    lines = [line for line in read_text(path, any_letters=True).splitlines() if line.strip()]
    lines = [line for line in lines if not line.lstrip().startswith('#')]
    for first, line in enumerate(lines[:TITLE_LINES]):
        if re.match('Tools[\t,;]', line):
            rows, read = _tool_tracker(lines[first:], path)
            break
        if 'Position:' in line:
            rows, read = _keyed(lines[first:], path)
            break
    else:
        rows, read = _table(path, unit), len(lines)
    if not any(one.rows for one in rows.values()):
        raise ParameterError(f'{path}: no row that is a pose')
    return rows, len(lines) - read


def _number(text: str) -> float:
    try:
        return float(text.strip(',;').replace(',', '.'))
    except ValueError:
        return float('nan')


def _tool_tracker(lines: Sequence[str], path: Path) -> Found:
    """NDI ToolTracker: a group of columns a port; scalar first; states in words."""
    rows: dict[str, RawRows] = {}
    read, separator = 0, lines[0][len('Tools')]
    for line in lines:
        cells = line.split(separator)
        if cells[0] == 'Tools':  # once more where the program was started again
            read += 1
            continue
        read, seen = read + (len(cells) >= PORT_COLUMNS), set()
        for start in range(1, len(cells), PORT_COLUMNS):
            port = cells[start : start + PORT_COLUMNS]
            if len(port) < PORT_COLUMNS - 1:
                continue
            label = re.sub(r'\W+', '_', port[0].split(':')[0].strip().lower())
            rate = POLARIS_HZ if 'OT' in port[0] else AURORA_HZ
            new = RawRows(form='wxyz', assumed_hz=0.0 if label else rate)
            label = label or f'port_{1 + start // PORT_COLUMNS}'
            if label in seen:
                raise ParameterError(f'{path}: two ports are called {label}: label them apart')
            seen.add(label)
            one = rows.setdefault(label, new)
            numbers = [_number(cell) for cell in port[4:11]]
            good = port[3].strip() in ('OK', 'Partially Out of Volume')
            pose = (*numbers[4:7], *numbers[:4]) if good else (float('nan'),) * 7
            one.rows.append((float('nan'), _number(port[1]) / rate, *pose))
    return rows, read


def _keyed(lines: Sequence[str], path: Path) -> Found:
    """Lines such as ``SensorID: 0 Position: x y z Orientation: a b c d Time: ns``."""
    rows: dict[str, RawRows] = {}
    for line in lines:
        line = _NO_COLON.sub(r'\1:', line)
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


def _plus(path: Path) -> dict[str, RawRows]:
    """A sequence of PLUS: matrices of tools in the tracker's frame, mm, before any pictures."""
    frames: dict[str, dict[str, str]] = {}
    for number, key, value in _PLUS_FIELD.findall(path.read_bytes().decode('latin-1')):
        frames.setdefault(number, {})[key] = value
    rows: dict[str, RawRows] = {}
    for fields in frames.values():
        for key, value in fields.items():
            if not key.endswith('ToTrackerTransform'):
                continue
            matrix = np.array([_number(cell) for cell in value.split()])
            pose = np.full(7, np.nan)
            if matrix.size == 16 and fields.get(f'{key}Status', 'OK') == 'OK':
                turn = nearest_rotation(matrix.reshape(4, 4)[:3, :3])
                pose = np.concatenate([matrix[3:12:4], Rotation.from_matrix(turn).as_quat()])
            one = rows.setdefault(key.removesuffix('ToTrackerTransform').lower(), RawRows())
            one.rows.append((_number(fields.get('Timestamp', '')), np.nan, *pose.tolist()))
    if not rows:
        raise ParameterError(f'{path}: a sequence of PLUS without ...ToTrackerTransform')
    return rows


def _table(path: Path, unit: str | None) -> dict[str, RawRows]:
    """A table with names of columns, or one of TUM's eight numbers."""
    table = read_table(path)
    names = table.names if table.has_names else TUM
    if len(names) != len(table.names):
        matrix = ', so these are matrices' if len(table.names) in (12, 16) else ''
        words = f'{len(table.names)} numbers a line and no names of columns'
        raise ParameterError(f'{path}: {words}; times, places and quaternions are 8{matrix}')
    try:
        bodies, clocks = pose_columns(names, table.units)
        time = np.sum([_seconds(table, *clock) for clock in clocks], axis=0)
    except ParameterError as error:
        raise ParameterError(
            f'{error}' if str(path) in f'{error}' else _advice(table, error)
        ) from error
    stated = _stated_unit(table)
    label = next((n for n in table.names if n.casefold() in LABELS), '')
    whose = np.array(table.words(label) if label else [''] * len(table.cells))
    rows: dict[str, RawRows] = {}
    for body, columns in bodies.items():
        cells = [table.names[column] for column in (*columns.place, *columns.turn)]
        pose = table.numbers(cells, with_gaps=True)
        recorded.check_not_zero(path, pose[:, 3:])
        pose[_without_pose(table, set(bodies) - {body})] = np.nan
        for name in dict.fromkeys(whose.tolist()):
            here = whose == name
            _check_times(path, time[here])
            check_rising(path, time[here], table.cells.index[here])
            lines = np.column_stack([time[here], np.full(here.sum(), np.nan), pose[here]])
            called = '_'.join(filter(None, (name, body))) if name or len(bodies) > 1 else path.stem
            rows[called] = RawRows(lines.tolist(), unit=columns.unit or stated)
            if unit and table.has_names and rows[called].unit not in (unit, ''):
                raise ParameterError(f'{path}: its header says {rows[called].unit}, --unit {unit}')
    return rows


def _without_pose(table: Table, others: set[str]) -> Booleans:
    """Rows (n,) of which a column that is not of another body says that they are no pose."""
    none = np.zeros(len(table.cells), dtype=bool)
    for column in (name for name in table.names if not meaning_of(name).kind):
        words = set(words_of(column))
        for kinds, text in NO_POSE:
            if words & kinds and not any(words >= set(other.split('_')) for other in others):
                none |= table.words(column).str.fullmatch(text, case=False).to_numpy(dtype=bool)
    return none


def _stated_unit(table: Table) -> str:
    """The unit of lengths that a title states; empty where none does."""
    cells = (pair for row in table.titles for pair in pairwise(row))
    unit = next((unit for key, unit in cells if 'length unit' in key.lower()), '')
    return UNITS.get(unit.casefold(), '')


def _seconds(table: Table, column: int, unit: str) -> Array:
    """A column of times, s; without a unit what the numbers alone can be."""
    time = table.array(table.names[column]).astype(np.float64)
    unit = unit or _unit_of(time)
    if not unit:
        raise ParameterError(f'{table.names[column]} states no unit of time, or is a counter')
    return np.asarray(time * (TIME_NS[unit] * NANO))


def _unit_of(time: Array) -> str:
    """The unit that times can have; empty if they do not count since 1970, and no tracker gives
    them in seconds: they are whole numbers, or far apart."""
    known = time[np.isfinite(time)]
    if not known.size or not np.ptp(known):
        return 's'
    middle, apart = np.median(known), np.median(np.diff(known, append=known[-1:]))
    unit = next((u for low, high, u in UNITS_OF_TIME if low < middle < high), 's')
    is_odd = apart > LONGEST_INTERVAL_S or not np.any(known % 1)
    return '' if unit == 's' and is_odd and middle < RECENT_NS * NANO else unit


def _check_times(path: Path, time: Array) -> None:
    steps = np.diff(time[np.isfinite(time)])
    if steps.size and not steps.any():
        raise ParameterError(
            f'{path}: all {steps.size + 1} times are {time[0]:g} s: is it a time?'
        )
    if steps.size and np.mean(steps < 0) > MOST_FALLS:
        raise ParameterError(
            f'{path}: the times do not ascend: {np.count_nonzero(steps < 0)} of {steps.size} are '
            'before the one above them; is the first column a time?'
        )
    apart = float(np.median(steps[steps > 0])) if np.any(steps > 0) else SHORTEST_INTERVAL_S
    if apart < SHORTEST_INTERVAL_S:
        raise ParameterError(
            f'{path}: times are {apart:.2g} s apart: days (MATLAB, Excel)? Give seconds'
        )


def _advice(table: Table, error: ParameterError) -> str:
    """What a header lacks, what it has, and a document for `anser import`, written beside it."""
    path = Path(table.path)
    document = path.with_name(f'{path.stem}.tables.yaml')
    found = list(map(meaning_of, table.names, table.units))
    seen: dict[tuple[str, str], str] = {}
    for name, one in zip(table.names, found, strict=True):
        seen.setdefault((one.kind, 'w' if one.axis == '0' else one.axis), name)
    stamp = seen.get(('time', ''), '?')
    words = f'{path}: {error}; its columns are {", ".join(table.names)}'
    turns = [seen.get(('turn', axis), '?') for axis in 'xyzw']
    if any(one.kind == 'angle' for one in found) or turns[2:] == [turns[2], '?'] != ['?', '?']:
        return f'{words}: angles are not read, give their quaternion'
    units = {one.kind: one.unit for one in found}
    start_ns = SECOND_NS
    with contextlib.suppress(ParameterError):
        times = table.array(stamp).astype(np.float64)
        units['time'] = units.get('time') or _unit_of(times)
        start_ns = 0 if np.nanmin(times) > 0.0 else start_ns
    text = yaml.safe_dump({
        'schema': SCHEMA, 'time': {'unit': units.get('time') or '?', 'start_ns': start_ns},
        'tracked': [{
            'file': path.name, 'stamp': stamp,
            'sensor': recorded.legal_name(path.stem),
            'position': [seen.get(('place', axis), '?') for axis in 'xyz'],
            'unit': units.get('place') or _stated_unit(table) or '?',
            'quaternion': turns, 'order': 'xyzw',
        }],
    }, sort_keys=False, default_flow_style=None, width=1000)  # fmt: skip
    note = 'Unit of time: s, ms, us, ns, or the seconds of a count; of length: m, cm, mm, um, inch'
    with contextlib.suppress(OSError), document.open('x', encoding='utf-8') as stream:
        stream.write(f'# Columns: {", ".join(table.names)}\n# {note}\n{text}')
    return (
        f'{words}: say what they mean in {document}, and read it by: anser import {document} '
        '--out session.mcap'
    )
