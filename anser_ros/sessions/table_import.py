"""Makes a session of tables of fluxes or tracked poses, and of optical poses, by a document.

The document names the files, their columns, units, the order of quaternions and the time base;
`docs/howto/import.md` has every key with examples.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from anser_ros.errors import ParameterError
from anser_ros.sessions.plausibility import check_positions
from anser_ros.stamps import NANO, stamp_fault
from anser_ros.wire import recorded
from anser_ros.wire.bag_writer import FLUX_TOPICS, SessionWriter
from anser_ros.wire.number_tables import NumberTable, read_arrays
from anser_ros.wire.setup import FIELD_GENERATOR, Setup, parse_setup
from anser_ros.wire.setup_values import read_name
from anser_ros.wire.table_names import LENGTH_M, TIME_NS
from anser_ros.wire.tables import Span, check_apart, check_rising
from anser_ros.wire.text_files import read_text, read_yaml

Array = NDArray[Any]

SCHEMA = 'anser_import/1'
FLUX_T = {'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'pT': 1e-12}
"""Tesla in a unit of flux density."""
ORDERS = {'xyzw': (0, 1, 2, 3), 'wxyz': (1, 2, 3, 0)}
"""Where x, y, z, w stand in a quaternion of that order."""


def import_tables(document: Path, out: Path) -> tuple[dict[str, int], list[str]]:
    """Write the session that a document describes; return messages by topic, and what lacks.

    Raises `ParameterError`, `SetupError`, `BagError` with the file's name.
    """
    text = read_text(document)
    try:
        for number, line in enumerate(text.splitlines(), 1):
            if "'?'" in line:
                raise ParameterError(f'line {number} lacks what stands for ?: {line.strip()}')
        made = _Import(read_yaml(text), document.parent)
        return made.write(out), made.notes
    except (ParameterError, yaml.YAMLError) as error:
        text = ' '.join(str(error).split())
        message = text if str(document.parent) in text else f'{document}: {text}'
        raise ParameterError(message) from error


class _Spec:
    """A mapping in the document, what it is called, and values of its keys, which are known."""

    def __init__(self, values: Any, what: str, *keys: str) -> None:
        if not isinstance(values, dict):
            raise ParameterError(f'{what} must be a mapping')
        if unknown := sorted(str(key) for key in values if key not in keys):
            words = f'no key {", ".join(unknown)}; there are: {", ".join(keys)}'
            raise ParameterError(f'{what}: {words}')
        self.what, self.get = what, values.get

    def needed(self, key: str) -> Any:
        if self.get(key) is None:
            raise ParameterError(f'{self.what} lacks {key}')
        return self.get(key)

    def choice(self, key: str, known: Mapping[str, float], usual: str) -> float:
        given = self.get(key, usual)
        if given not in known:
            words = f'{key} must be among {", ".join(known)}, got {given!r}'
            raise ParameterError(f'{self.what}: {words}')
        return known[given]


class _Import:
    """One document's import."""

    def __init__(self, document: Any, folder: Path) -> None:
        kinds = 'fluxes', 'tracked', 'poses'
        spec = _Spec(document, 'the document', 'schema', 'setup', 'time', *kinds)
        if spec.get('schema') != SCHEMA:
            raise ParameterError(f'schema must be {SCHEMA}, got {spec.get("schema")!r}')
        self._folder = folder
        tables = {key: spec.get(key) or [] for key in kinds}
        if not all(isinstance(entries, list) for entries in tables.values()):
            raise ParameterError(f'{", ".join(kinds)} must be lists of tables')
        if bool(tables['fluxes']) == bool(tables['tracked']):
            raise ParameterError(
                'needs fluxes (tables of a board with a setup), or tracked (tables of a tracker '
                'that gives poses), one of the two'
            )
        self._setup: Setup | None = None
        self._setup_text = ''
        if tables['fluxes']:
            self._setup_text = read_text(folder / str(spec.needed('setup')))
            self._setup = parse_setup(self._setup_text)
        elif spec.get('setup') is not None:
            raise ParameterError('a setup describes fluxes; tracked poses have none')
        self._time = _time_base(spec.get('time', {}), 'time')
        self._entries: list[tuple[int, Callable[..., None]]] = []
        self._tables: dict[Path, NumberTable] = {}
        self._messages: Counter[str] = Counter()
        self._spans: list[Span] = []
        self.notes: list[str] = []
        for key, entries in tables.items():
            for number, entry in enumerate(entries):
                what = f'{key}[{number}]'
                if self._setup is not None and key == 'fluxes':
                    self._add_fluxes(entry, what, self._setup)
                else:
                    self._add_poses(entry, what, is_tracked=key == 'tracked')
        if not self._entries:
            raise ParameterError('the tables have no complete row')
        if self._setup is None:
            tracked, optical = (
                [t[len(k) : -len(recorded.ENDING)] for t in self._messages if t.startswith(k)]
                for k in (recorded.TRACKED, recorded.OPTICAL)
            )
            self._setup_text = recorded.pose_setup(tracked, [*optical, recorded.BODY][0])

    def write(self, out: Path) -> dict[str, int]:
        """Write all by its stamps."""
        self._entries.sort(key=lambda entry: entry[0])
        frame = 'tracker' if self._setup is None else self._setup.frame_id
        with SessionWriter(out, frame) as writer:
            writer.write_setup(self._setup_text, self._entries[0][0])
            for _, put in self._entries:
                put(writer)
        return dict(self._messages)

    def _table(self, entry: _Spec) -> NumberTable:
        path = self._folder / str(entry.needed('file'))
        if path not in self._tables:
            self._tables[path] = read_arrays(path)
        return self._tables[path]

    def _stamps(self, table: NumberTable, entry: _Spec) -> list[int]:
        column, time = table.column(entry.needed('stamp')), entry.get('time')
        base = self._time if time is None else _time_base(time, f'{entry.what}: time')
        unit_ns, start_ns = base
        if column.dtype.kind in 'iu':  # exact, as nanoseconds since 1970 have 19 digits
            stamps = [start_ns + round(int(v) * Fraction(unit_ns)) for v in column.tolist()]
        else:
            values = _real(column, table, str(entry.get('stamp')))
            if not np.isfinite(values).all():
                raise ParameterError(f'{table.path}: {entry.get("stamp")} has values not finite')
            stamps = [start_ns + round(v * unit_ns) for v in values.tolist()]
        if (different := len(set(stamps))) < 2 and len(stamps) != 1:
            words = f'all {len(stamps)} stamps are alike: are they set?' if stamps else 'no rows'
            raise ParameterError(f'{table.path}: {words}')
        lines = range(1, len(stamps) + 1) if table.table is None else table.table.cells.index
        check_rising(table.path, np.array(stamps) * NANO, lines)
        is_days = unit_ns == TIME_NS['day']
        if fault := stamp_fault(min(stamps), max(stamps), is_days) or '1970' * (min(stamps) <= 0):
            fault = fault if min(stamps) > 0 else 'a stamp is not after 1970; is start_ns missing?'
            raise ParameterError(f'{table.path}: {fault}')
        if different < len(stamps):
            raise ParameterError(
                f'{table.path}: the same stamp twice: cut to seconds, other unit?'
            )
        return stamps

    def _add_fluxes(self, given_entry: Any, what: str, setup: Setup) -> None:
        entry = _Spec(given_entry, what, 'file', 'stamp', 'time', 'unit', 'sensors', 'array')
        table, scale = self._table(entry), entry.choice('unit', FLUX_T, 'T')
        stamps = self._stamps(table, entry)
        by_name = {sensor.name: sensor for sensor in setup.sensors}
        given = entry.needed('sensors')
        names = list(given)
        unknown = [name for name in names if name not in by_name]
        if unknown or not names:
            raise ParameterError(
                f'{what}: the setup has no sensor {", ".join(map(str, unknown)) or "named here"}'
            )
        emitters = len(setup.emitter.coils)
        if array := entry.get('array'):
            flux = table.array(str(array))
            wanted = (len(stamps), len(names), emitters)
            if flux.shape != wanted:
                raise ParameterError(
                    f'{table.path}: {array} has shape {flux.shape}, not frames x sensors '
                    f'x emitters, which is {wanted}'
                )
        else:
            columns = _Spec(given, f'{what}: sensors', *names)
            beside = entry.get('stamp')
            parts = [_phasors(table, columns.get(n), emitters, n, beside) for n in names]
            flux = np.stack(parts, axis=1)
        flux = scale * np.asarray(flux, dtype=np.complex128)
        sensors = [by_name[name] for name in names]
        for stamp, values in zip(stamps, flux, strict=True):
            put = partial(
                SessionWriter.write_readings, sensors=sensors, stamp_ns=stamp, flux=values
            )
            self._entries.append((stamp, put))
        for topic, fixed in FLUX_TOPICS.items():
            if any((s.body == FIELD_GENERATOR) == fixed for s in sensors):
                self._messages[topic] += len(stamps)

    def _add_poses(self, given: Any, what: str, *, is_tracked: bool) -> None:
        key = 'sensor' if is_tracked else 'body'
        others = 'position', 'unit', 'quaternion', 'order'
        entry = _Spec(given, what, 'file', 'stamp', 'time', key, *others)
        table, name = self._table(entry), read_name(entry.needed(key), what)
        if self._setup is not None and name not in self._setup.bodies:
            raise ParameterError(f'{what}: the setup has no body {name}')
        topic = recorded.tracked_topic(name) if is_tracked else recorded.optical_topic(name)
        scale, order = entry.choice('unit', LENGTH_M, 'm'), entry.get('order')
        if order not in ORDERS:
            raise ParameterError(f'{what}: order must be {" or ".join(ORDERS)}, got {order!r}')
        stamps = self._stamps(table, entry)
        check_apart(self._spans, topic, table.path, np.array(stamps) * NANO)
        position, quaternion = (
            _real(table.columns(entry.get(k), n, f'{what}: {k}', entry.get('stamp')), table, k)
            for k, n in (('position', 3), ('quaternion', 4))
        )
        quaternion = quaternion[:, ORDERS[order]]
        good = np.isfinite(position).all(axis=1) & np.isfinite(quaternion).all(axis=1)
        unit = np.isfinite(recorded.unit_quaternions(quaternion)).all(axis=1)
        none = good & (quaternion == 0.0).all(axis=1)
        recorded.check_not_zero(table.path, quaternion)
        if (good & ~unit & ~none).any():
            raise ParameterError(f'{table.path}: quaternions are not of unit length')
        good &= unit
        quaternion[good] = recorded.unit_quaternions(quaternion[good])
        if lacking := len(stamps) - int(good.sum()):
            words = f'{lacking} pose{"s" * (lacking > 1)} without numbers or rotation left out'
            self.notes.append(f'{table.path}: {words}')
        check_positions(str(table.path), scale * position[good])
        for row in np.flatnonzero(good).tolist():
            put = partial(
                SessionWriter.write_pose, topic=topic, stamp_ns=stamps[row],
                position=(scale * position[row]).tolist(),
                quaternion_xyzw=quaternion[row].tolist(),
            )  # fmt: skip
            self._entries.append((stamps[row], put))
        self._messages[topic] += int(good.sum())


def _time_base(given: Any, what: str) -> tuple[float, int]:
    """The unit of a column of stamps, ns, and the stamp of its zero."""
    time = _Spec(given, what, 'unit', 'start_ns')
    start_ns = time.get('start_ns', 0)
    if not isinstance(start_ns, int) or isinstance(start_ns, bool):
        raise ParameterError(f'{what}: start_ns must be a whole number, got {start_ns!r}')
    unit = time.get('unit', 's')
    if type(unit) in (int, float) and unit > 0:  # seconds from one count to the next
        return unit * TIME_NS['s'], start_ns
    return time.choice('unit', TIME_NS, 's'), start_ns


def _phasors(table: NumberTable, given: Any, emitters: int, name: str, beside: Any) -> Array:
    """Fluxes of one sensor, shape (F, K): complex columns, or those of ``re`` and ``im``."""
    if isinstance(given, dict):
        spec = _Spec(given, name, 're', 'im')
        parts = [
            _real(table.columns(spec.get(part), emitters, f'{name}: {part}', beside), table, name)
            for part in ('re', 'im')
        ]
        return np.asarray(parts[0] + 1j * parts[1])
    found = table.columns(given, emitters, name, beside)
    if found.dtype.kind not in 'fiuc':
        raise ParameterError(f'{table.path}: {name} has cells that are not numbers')
    return found


def _real(values: Array, table: NumberTable, name: str) -> Array:
    if values.dtype.kind not in 'fiu':
        raise ParameterError(f'{table.path}: {name} has cells that are not real numbers')
    return np.asarray(values, dtype=np.float64)
