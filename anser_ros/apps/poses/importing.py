"""Reads sessions of poses: files as trackers write them, and bags by topic; writes bags."""

import contextlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.sequence import (
    FARTHEST,
    REFERENCE,
    PoseSequence,
    PoseSession,
    sequence_of,
    stamp_words,
)
from anser_ros.arrays import Array, Integers
from anser_ros.errors import BagError, ParameterError
from anser_ros.physics.rotations import nearest_rotation
from anser_ros.sessions.table_import import SCHEMA
from anser_ros.stamps import NANO, RECENT_NS, SECOND_NS, stamp_fault
from anser_ros.wire import recorded
from anser_ros.wire.bag import Salvage, published_poses
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.table_names import LENGTH_M, TIME_NS, UNITS, meaning_of, pose_columns
from anser_ros.wire.tables import Table, read_table
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
VALID = ('valid', 'visible', 'tracked', 'is_valid')
"""Columns that say whether a row is a pose."""
NOT_VALID = ('0', 'false', 'no')
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

    @property
    def table(self) -> Array:
        """Return the rows as an array, shape (n, 9)."""
        return np.array(self.rows, dtype=np.float64).reshape(-1, 9)


Found = tuple[dict[str, RawRows], int]
"""Rows by the sensor's name, and a number of lines."""


def read_form(path: Path) -> Found:
    """Read a file of any known form: its rows, and how many lines hold no pose and no marker.

    Lines before the first that has the form, such as a title, are left out. Raises
    `ParameterError` when no form fits, or the file has no row.
    """
    if path.suffix.lower() in PLUS:
        return _plus(path), 0
    lines = [line for line in read_text(path, any_letters=True).splitlines() if line.strip()]
    lines = [line for line in lines if not line.lstrip().startswith('#')]
    for first, line in enumerate(lines[:TITLE_LINES]):
        if line.startswith(('Tools\t', 'Tools,')):
            rows, read = _tool_tracker(lines[first:])
            break
        if 'Position:' in line:
            rows, read = _keyed(lines[first:], path)
            break
    else:
        rows, read = _table(path), len(lines)
    if not any(one.rows for one in rows.values()):
        raise ParameterError(f'{path}: no row that is a pose')
    return rows, len(lines) - read


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float('nan')


def _tool_tracker(lines: Sequence[str]) -> Found:
    """NDI ToolTracker: a group of columns a port; scalar first; states in words."""
    rows: dict[str, RawRows] = {}
    read, separator = 0, lines[0][len('Tools')]
    for line in lines:
        cells = line.split(separator)
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


def _table(path: Path) -> dict[str, RawRows]:
    """A table with names of columns, or one of TUM's eight numbers."""
    table = read_table(path)
    names = table.names if table.has_names else TUM
    if len(names) != len(table.names):
        matrix = ', so these are matrices' if len(table.names) in (12, 16) else ''
        words = f'{len(table.names)} numbers a line and no names of columns'
        raise ParameterError(f'{path}: {words}; times, places and quaternions are 8{matrix}')
    try:
        bodies, clocks = pose_columns(names, table.units)
        time = np.sum([_seconds(table, column, unit) for column, unit in clocks], axis=0)
    except ParameterError as error:
        raise ParameterError(
            f'{error}' if str(path) in f'{error}' else _advice(table, error)
        ) from error
    stated = next(
        (u for row in table.titles for k, u in pairwise(row) if 'length unit' in k.lower()), ''
    )
    label, valid = (
        next((n for n in table.names if n.casefold() in known), '') for known in (LABELS, VALID)
    )
    whose = np.array(table.words(label) if label else [''] * len(table.cells))
    rows: dict[str, RawRows] = {}
    for body, columns in bodies.items():
        cells = [table.names[column] for column in (*columns.place, *columns.turn)]
        pose = table.numbers(cells, with_gaps=True)
        if valid:
            pose[table.words(valid).str.casefold().isin(NOT_VALID)] = np.nan
        for name in dict.fromkeys(whose.tolist()):
            here = whose == name
            _check_times(path, time[here])
            lines = np.column_stack([time[here], np.full(here.sum(), np.nan), pose[here]])
            called = '_'.join(filter(None, (name, body))) if name or len(bodies) > 1 else path.stem
            unit = columns.unit or UNITS.get(stated.casefold(), '')
            rows[called] = RawRows(lines.tolist(), unit=unit)
    return rows


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
        seen.setdefault((one.kind, one.axis), name)
    stamp = seen.get(('time', ''), '?')
    units = {one.kind: one.unit for one in found}
    with contextlib.suppress(ParameterError):
        units['time'] = units.get('time') or _unit_of(table.array(stamp).astype(np.float64))
    text = yaml.safe_dump({
        'schema': SCHEMA, 'time': {'unit': units.get('time') or 's', 'start_ns': 0},
        'tracked': [{
            'file': path.name, 'stamp': stamp,
            'sensor': recorded.legal_name(path.stem),
            'position': [seen.get(('place', axis), '?') for axis in 'xyz'],
            'unit': units.get('place') or 'm',
            'quaternion': [seen.get(('turn', axis), '?') for axis in 'xyzw'], 'order': 'xyzw',
        }],
    }, sort_keys=False, default_flow_style=None)  # fmt: skip
    with contextlib.suppress(OSError), document.open('x', encoding='utf-8') as stream:
        stream.write(f'# Columns: {", ".join(table.names)}\n{text}')
    return (
        f'{path}: {error}; its columns are {", ".join(table.names)}: say what they mean in '
        f'{document}, and read it by: anser import {document} --out session.mcap'
    )


Piece = tuple[str, Array, Array, Array]
"""Name of a stream, and of one of its recordings times, s, positions, m, and quaternions."""
BETWEEN_FILES_S = 10.0
"""Pause, s, between recordings without a host's time; nothing interpolates over a tenth of it."""
SET_S, CLOCKS_APART = 0.3, 3e-3
"""Time, s, and share of the time passed, by which clocks that nobody sets may move against each
other between recordings: these start late by some 40 ms, and quartz errs by a thousandth."""
MOST_RESTARTS = 5
"""Falls of a counter in a recording that may be restarts; with more, rows are in no order."""
STAMPS = ('host', 'device')  # which time becomes the stamp; the other where a file lacks the one


def import_poses(
    tracked: Sequence[Path],
    reference: Sequence[Path] = (),
    *,
    stamps: str = 'host',
    unit: str | None = None,
    quaternion: str | None = None,
    names: Mapping[str, str] | None = None,
    shift_s: tuple[float, float] = (0.0, 0.0),
) -> PoseSession:
    """Read files of tracked poses, and of the reference's, as one session.

    ``tracked`` and ``reference``: several of each are recordings one after the other, the n-th of
    both together; ``unit``: unit of the tracked positions where the form does not state it
    correctly (`LENGTH_M`); ``quaternion``: how the tracked quaternions are written where it is not
    as usual in their form (`ORDERS`); ``names``: what sensors shall be called, by the names that
    the files give them; ``shift_s``: added to the times of the tracked poses and of the reference,
    where a host's clock has given them. Raises `ParameterError` when a file has no known form, an
    option no known value, numbers of files differ, or names fit no sensor or become the same.
    Raises `PlausibilityError` when quaternions are not of unit length.
    """
    for value, known in ((stamps, STAMPS), (unit, LENGTH_M), (quaternion, ORDERS)):
        if value is not None and value not in known:
            raise ParameterError(f'must be one of {", ".join(known)}, got {value!r}')
    if reference and len(reference) != len(tracked):
        raise ParameterError(
            f'{len(tracked)} files of tracked poses and {len(reference)} of the reference; '
            'they belong together one by one'
        )
    recordings: list[dict[str, Array]] = []
    lost: list[str] = []
    for number, path in enumerate(tracked):
        rows, unread = read_form(path)
        groups, files = _named(path, rows, None, unit, quaternion), [(path, unread)]
        if reference:
            if REFERENCE in groups:  # a file that says nothing of its sensor
                groups['sensor_0'] = groups.pop(REFERENCE)
            rows, unread = read_form(reference[number])
            groups |= _named(reference[number], rows, REFERENCE, None, None)
            files.append((reference[number], unread))
        words = 'lines of {} that are no poses, and are left out: {}'
        lost += [words.format(*one) for one in files if one[1]]
        for label, table in groups.items():
            if not np.isfinite(table[:, :2]).any():
                raise ParameterError(f'{path}: {label}: no pose has a time')
        recordings.append(groups)
    pieces = _placed(recordings, stamps, shift_s)
    called = _called([piece[0] for piece in pieces], names or {})
    lost += [
        f'{old} is called {new}'
        for old, new in called.items()
        if old not in (names or {}) and old != new
    ]
    renamed = [(called[piece[0]], *piece[1:]) for piece in pieces]
    session = _session(str(tracked[0]), renamed)
    return replace(session, lost='; '.join(filter(None, (*lost, session.lost))))


def _called(found: Sequence[str], names: Mapping[str, str]) -> dict[str, str]:
    """What sensors are called: as they shall be, or as a topic can be."""
    sensors = [name for name in dict.fromkeys(found) if name != REFERENCE]
    unknown = sorted(set(names) - set(sensors))
    if unknown:
        raise ParameterError(f'no sensor {", ".join(unknown)}; there are: {", ".join(sensors)}')
    called = {name: names.get(name) or recorded.legal_name(name) for name in sensors}
    new = list(called.values())
    if len(set(new)) < len(new) or REFERENCE in new:
        raise ParameterError(f'sensors must differ in name, and from optical: {", ".join(new)}')
    return {**called, REFERENCE: REFERENCE}


def _placed(
    recordings: Sequence[Mapping[str, Array]], stamps: str, shift_s: tuple[float, float]
) -> list[Piece]:
    """All recordings on one axis of time. Two devices that count for themselves start together,
    and their counters go on in the next recording if both have moved on alike since the last.
    """
    times: list[dict[str, tuple[Array, bool]]] = [{} for _ in recordings]
    for label in dict.fromkeys(label for groups in recordings for label in groups):
        own = [k for k, groups in enumerate(recordings) if label in groups]
        found = _times([recordings[k][label] for k in own], stamps)
        for k, one in zip(own, found, strict=True):
            times[k][label] = one
    pieces: list[Piece] = []
    free = 0.0  # where the next recording without a host's time begins, s
    zero: dict[bool, float] = {}
    last: dict[bool, float] = {}
    for groups, known in zip(recordings, times, strict=True):
        begin: dict[bool, float] = {}  # by whether it is the reference
        for label, (time, is_host) in known.items():
            if not is_host:
                key = label == REFERENCE
                begin[key] = min(begin.get(key, np.inf), float(np.nanmin(time)))
        runs_on = len(begin) == len(last) == 2 and _runs_on(
            last[False] - last[True], begin[False] - begin[True], begin[True] - last[True]
        )
        if not runs_on:
            zero = {key: value - free for key, value in begin.items()}
        last = begin
        for label, table in groups.items():
            time, is_host = known[label]
            is_reference = label == REFERENCE
            shift = -shift_s[is_reference] if is_host else zero[is_reference]
            pieces.append((label, time - shift, table[:, 2:5], table[:, 5:]))
        if begin:
            free = max(float(np.nanmax(p[1])) for p in pieces) + BETWEEN_FILES_S
    return pieces


def _runs_on(before: float, after: float, elapsed: float) -> bool:
    """Whether two counters, apart so much before and after a time, s, have not been set since."""
    return elapsed > 0 and abs(after - before) < SET_S + CLOCKS_APART * elapsed


def _named(
    path: Path,
    rows: Mapping[str, RawRows],
    name: str | None,
    unit: str | None,
    quaternion: str | None,
) -> dict[str, Array]:
    """Each group of rows (n, 9) under its name, with positions in m and quaternions x y z w."""
    if name is not None:  # of an optical file only the tool with most poses is the reference
        most = max(rows.values(), key=lambda one: np.isfinite(one.table[:, 2:]).all(1).sum())
        rows = {name: most}
    found = {}
    for label, one in rows.items():
        table = one.table
        order, sense = ORDERS[quaternion or one.form]
        away = np.linalg.norm(table[:, 2:5], axis=1)
        if (
            not (unit or one.unit)
            and np.nanmedian(np.where(away < FARTHEST, away, np.nan)) > FARTHEST_M
        ):
            raise ParameterError(
                f'{path}: {label}: positions of {np.nanmedian(away):.4g} state no unit: --unit mm?'
            )
        table[:, 2:5] *= LENGTH_M[unit or one.unit or 'm']
        table[:, 5:] = table[:, 5:][:, list(order)]
        table[:, 5:8] *= sense
        found[label] = table
    return found


def _times(tables: Sequence[Array], stamps: str) -> list[tuple[Array, bool]]:
    """Times of a stream's recordings, s, and whether they are on the host's axis.

    A device's counter that runs on has one zero on that axis, whose drift is its clock's rate.
    """
    out, pieces = [], []
    for table in tables:
        host, device = table[:, 0], table[:, 1].copy()
        if not np.isfinite(host).any():
            out.append((_continued(device), False))
            continue
        if stamps == 'host' or not np.isfinite(device).any():
            out.append((host, True))
            continue
        out.append((device, True))
        order = np.argsort(host, kind='stable')  # lines may be in another order than they came
        count = _restarts(device[order])
        for number in np.unique(count):
            rows = order[count == number]
            late = host[rows] - device[rows]
            if np.isfinite(late).any():
                pieces.append(
                    (device, rows, float(np.nanmin(late)), float(np.nanmin(device[rows])))
                )
    zero, last = 0.0, None
    for device, rows, late, begin in pieces:
        if last is None or not _runs_on(last[0], late, begin - last[1]):
            zero = late
        last = late, begin
        device[rows] += zero
    return out


def _restarts(counter: Array) -> Integers:
    """How often a counter has fallen by more than a second before each of its values."""
    known = np.flatnonzero(np.isfinite(counter))
    falls = np.zeros(counter.size, dtype=np.int64)
    falls[known[1:]] = np.diff(counter[known]) < -1.0
    if falls.sum() > MOST_RESTARTS:
        return np.zeros_like(falls)
    return np.asarray(np.cumsum(falls))


def _continued(counter: Array) -> Array:
    """A counter that goes on from its last value where it restarts."""
    count, out, last = _restarts(counter), counter.copy(), 0.0
    for number in np.unique(count)[1:]:
        before = counter[count == number - 1]
        rows = count == number
        last += np.nanmax(before) - np.nanmin(counter[rows])
        out[rows] += last
    return out


def _session(path: str, pieces: Sequence[Piece]) -> PoseSession:
    start = min(float(np.nanmin(time)) for _, time, _, _ in pieces)
    end = max(float(np.nanmax(time)) for _, time, _, _ in pieces)
    if fault := stamp_fault(int(start * SECOND_NS), int(end * SECOND_NS)):
        raise ParameterError(f'{path}: {fault}')
    sequences: dict[str, PoseSequence] = {}
    for label in dict.fromkeys(piece[0] for piece in pieces):
        chosen = [piece for piece in pieces if piece[0] == label]
        time, position, turn = (np.concatenate([p[i] for p in chosen]) for i in (1, 2, 3))
        known = np.isfinite(time)
        sequences[label] = sequence_of(label, time[known] - start, position[known], turn[known])
    # A file of optical poses alone is somebody's tracker too.
    reference = sequences.pop(REFERENCE, None) if len(sequences) > 1 else None
    if not any(poses.size for poses in sequences.values()):
        raise ParameterError(f'{path}: no complete pose with a time')
    # A bag's stamp of zero means none.
    start_ns = max(round(start * 1e9), 1_000_000_000)
    return _judged(PoseSession(path, start_ns, sequences, reference))


def _judged(session: PoseSession) -> PoseSession:
    """The session with what its stamps show."""
    words = filter(None, (session.lost, stamp_words(session)))
    return replace(session, lost='; '.join(words))


def read_pose_session(
    path: str | os.PathLike[str],
    tracked: Mapping[str, str] | None = None,
    optical: str | None = None,
) -> PoseSession:
    """Read a bag of tracked and optical poses.

    ``tracked``: topic of each sensor by the sensor's name; by default all
    ``/tracked/<sensor>/pose``; ``optical``: topic of the reference; by default the only
    ``/optical/<body>/pose``. Raises `BagError` when the bag can't be read, or has no tracked
    poses, or several references. Raises `PlausibilityError` when quaternions are not of unit
    length.
    """
    name, salvage = os.fspath(path), Salvage()
    named = [*(tracked or {}).values(), *filter(None, [optical])]
    streams = published_poses(path, salvage=salvage)
    if not set(named) <= set(streams):  # poses of another type, of which there may be more
        streams |= {t: s for t, s in published_poses(path, named).items() if s.stamp_ns.size}
    chosen = tracked or {
        topic[len(recorded.TRACKED) : -len(recorded.ENDING)]: topic
        for topic in sorted(streams)
        if topic.startswith(recorded.TRACKED) and topic.endswith(recorded.ENDING)
    }
    optics = [t for t in streams if t.startswith(recorded.OPTICAL) and t.endswith(recorded.ENDING)]
    if not optical and len(optics) > 1:
        raise BagError(f'{name}: several references, name one: {", ".join(sorted(optics))}')
    reference = optical or next(iter(optics), None)
    topics = [*chosen.values(), *([reference] if reference else [])]
    for topic in topics:
        if topic not in streams:
            known = ', '.join(sorted(streams)) or 'none'
            raise BagError(f'{name}: no poses on {topic}; topics of poses: {known}')
    if not chosen:
        raise BagError(
            f'{name}: no tracked poses, which are expected on '
            f'{recorded.TRACKED}<sensor>{recorded.ENDING}'
        )
    start = min(int(streams[topic].stamp_ns.min()) for topic in topics)

    def sequence(label: str, topic: str) -> PoseSequence:
        poses = streams[topic]
        time = np.asarray((poses.stamp_ns - start) * NANO)
        return sequence_of(label, time, poses.position, poses.quaternion)

    sensors = {label: sequence(label, topic) for label, topic in chosen.items()}
    found = sequence(REFERENCE, reference) if reference else None
    return _judged(PoseSession(name, start, sensors, found, salvage.lost))


def write_pose_session(path: Path, session: PoseSession) -> None:
    """Write a session of poses as a bag; where a device had no pose, values are NaN.

    Raises `BagError` when the file exists already.
    """
    sequences = [(recorded.tracked_topic(n), s) for n, s in session.sensors.items()]
    if session.reference is not None:
        sequences.append((recorded.optical_topic(recorded.BODY), session.reference))
    messages: list[tuple[int, str, list[float], list[float]]] = []
    for topic, poses in sequences:
        stamps, late = (
            (session.start_ns + np.round(time / NANO).astype(np.int64)).tolist()
            for time in (poses.time, poses.missing)
        )
        rows = zip(stamps, poses.position.tolist(), poses.quaternion.tolist(), strict=True)
        messages += [(stamp, topic, *row) for stamp, *row in rows]
        messages += [(stamp, topic, [np.nan] * 3, [np.nan] * 4) for stamp in late]
    messages.sort(key=lambda message: message[0])
    with SessionWriter(path, frame_id='tracker') as writer:
        setup = recorded.pose_setup(session.sensors, recorded.BODY)
        writer.write_setup(setup, messages[0][0] if messages else session.start_ns)
        for stamp, topic, position, quaternion in messages:
            writer.write_pose(topic, stamp, position, quaternion)
