"""Lays out the bytes of three point clouds, flux, field model and its uncertainty, without ROS.

Fields, tuples ``(name, offset, datatype, count)`` as in ``sensor_msgs/PointField``, are read by
name and offset, so others may lie between them; the uncertainty has one layout only.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.errors import LayoutError
from anser_ros.fingerprint import DIGITS

PointFieldTuple = tuple[str, int, int, int]

SATURATED = 1
"""Flag bit of a reading with a sample at an end of the converter's range."""
STALE = 2
"""Flag bit of a reading that is repeated because no newer one has arrived."""
DROPPED = 4
"""Flag bit of a reading with samples missing inside its window."""

MOST_POINTS = 1 << 16
"""Most points of a cloud: channels and dipoles are numbered by 16 bits."""
UINT16, UINT32, FLOAT32, FLOAT64 = 4, 6, 7, 8
"""Numbers of the data types of sensor_msgs/PointField that are used here."""
_CODES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
"""numpy's codes of all data types of sensor_msgs/PointField, by their number."""


@dataclass(frozen=True)
class FluxPoints:
    """Holds the fluxes of one demodulation window with a row for each sensor."""

    channel: Integers  # (S,)
    flags: Integers  # (S,), bits (`SATURATED`, `STALE`, `DROPPED`)
    flux: ComplexArray  # (S, K), complex, T, a column per emitter
    position: Array  # (S, 3), m, frame fg; NaN for sensors that move
    axis: Array  # (S, 3), unit vector, frame fg; NaN for sensors that move


@dataclass(frozen=True)
class DipolePoints:
    """Holds a model's dipoles: positions (N, 3) m, directions (N, 3), moments (N, K) A m^2."""

    positions: Array
    directions: Array
    moments: ComplexArray


@lru_cache(maxsize=8)  # a stream's clouds are all alike
def _record_type(
    fields: tuple[PointFieldTuple, ...], point_step: int, big_endian: bool
) -> np.dtype[np.void]:
    names, formats, offsets = [], [], []
    order = '>' if big_endian else '<'
    for name, offset, datatype, count in fields:
        if datatype not in _CODES:
            raise LayoutError(f'field {name!r} has the unknown datatype {datatype}')
        if count != 1:
            continue
        if name in names:
            raise LayoutError(f'field {name!r} appears twice')
        kind = np.dtype(order + _CODES[datatype])
        if offset < 0 or offset + kind.itemsize > point_step:
            raise LayoutError(f'field {name!r} at {offset} leaves the point of {point_step} bytes')
        names.append(name)
        formats.append(kind)
        offsets.append(offset)
    return np.dtype(
        {'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': point_step}
    )


def _records(
    fields: Sequence[PointFieldTuple],
    point_step: int,
    width: int,
    data: bytes | bytearray | memoryview,
    big_endian: bool,
) -> NDArray[np.void]:
    if point_step <= 0 or width < 0:
        raise LayoutError(f'point_step {point_step} and width {width} do not make a cloud')
    if width > MOST_POINTS:
        raise LayoutError(f'{width} points are refused, the most is {MOST_POINTS}')
    size = memoryview(data).nbytes
    if size != point_step * width:
        raise LayoutError(
            f'{width} points of {point_step} bytes need {point_step * width} bytes, got {size}'
        )
    record = _record_type(tuple(fields), point_step, big_endian)
    return np.frombuffer(data, dtype=record, count=width)


@lru_cache(maxsize=8)
def _doubles(names: tuple[str, ...]) -> np.dtype[np.void]:
    return np.dtype([(name, np.float64) for name in names])


def _columns(records: NDArray[np.void], names: tuple[str, ...]) -> Array:
    present = records.dtype.names or ()
    missing = [name for name in names if name not in present]
    if missing:
        raise LayoutError(f'the cloud lacks the field {missing[0]!r}')
    with np.errstate(invalid='ignore'):  # a signalling NaN is as good as any other
        out = records[[*names]].astype(_doubles(names))
    return out.view(np.float64).reshape(len(records), len(names))


def _integers(values: Array, name: str) -> Integers:
    if not (np.abs(values) < 2.0**31).all():
        raise LayoutError(f'the field {name!r} holds values that are not small integers')
    return values.astype(np.int64)


def _phasors_of(records: NDArray[np.void], stem: str) -> list[str]:
    """Return the names of the columns of all phasors, one at least."""
    present = set(records.dtype.names or ())
    count = 0
    while f'{stem}{count}_re' in present or f'{stem}{count}_im' in present:
        count += 1
    return phasor_names(stem, max(count, 1))


def decode_flux(
    fields: Sequence[PointFieldTuple],
    point_step: int,
    width: int,
    data: bytes | bytearray | memoryview,
    is_bigendian: bool = False,
) -> FluxPoints:
    """Read a flux cloud; raises `LayoutError` with what is wrong with fields, size or values."""
    records = _records(fields, point_step, width, data, is_bigendian)
    rest = 'channel', 'flags', *_phasors_of(records, 'coil')
    values = _columns(records, ('x', 'y', 'z', 'nx', 'ny', 'nz', *rest))
    channel = _integers(values[:, 6], 'channel')
    if len(set(channel.tolist())) != channel.size:
        raise LayoutError('a channel appears twice in the cloud')
    return FluxPoints(
        channel=channel,
        flags=_integers(values[:, 7], 'flags'),
        flux=np.ascontiguousarray(values[:, 8:]).view(np.complex128),
        position=values[:, :3],
        axis=values[:, 3:6],
    )


def packed(columns: Iterable[tuple[str, int]]) -> tuple[list[PointFieldTuple], int]:
    """Return the fields of columns (name, datatype) without gaps, and point_step."""
    fields, step = [], 0
    for name, datatype in columns:
        fields.append((name, step, datatype, 1))
        step += np.dtype(_CODES[datatype]).itemsize
    return fields, step


def phasor_names(stem: str, n_emitters: int) -> list[str]:
    """Return the names of the columns of phasors, real and imaginary part of each emitter."""
    return [f'{stem}{k}_{part}' for k in range(n_emitters) for part in ('re', 'im')]


@cache
def flux_fields(n_emitters: int) -> tuple[list[PointFieldTuple], int]:
    """Return the fields and point_step of the flux layout (92 bytes with eight emitters)."""
    geometry = [(name, FLOAT32) for name in ('x', 'y', 'z', 'nx', 'ny', 'nz')]
    phasors = [(name, FLOAT32) for name in phasor_names('coil', n_emitters)]
    return packed([*geometry, ('channel', UINT16), ('flags', UINT16), *phasors])


def encode_flux(points: FluxPoints) -> tuple[list[PointFieldTuple], int, bytes]:
    """Pack a flux cloud: fields, point_step and bytes."""
    count, n_emitters = points.flux.shape
    fields, step = flux_fields(n_emitters)
    head = np.dtype([('g', '<f4', 6), ('c', '<u2'), ('f', '<u2'), ('v', '<f4', 2 * n_emitters)])
    out = np.zeros(count, dtype=head)
    out['g'][:, :3], out['g'][:, 3:] = points.position, points.axis
    out['c'], out['f'] = points.channel, points.flags
    out['v'][:, 0::2], out['v'][:, 1::2] = points.flux.real, points.flux.imag
    return fields, step, out.tobytes()


def as_sent(points: FluxPoints) -> FluxPoints:
    """Return fluxes as a reader of their message has them: in single precision."""
    single = points.flux.astype(np.complex64).astype(np.complex128)
    return FluxPoints(points.channel, points.flags, single, points.position, points.axis)


def decode_field_model(
    fields: Sequence[PointFieldTuple],
    point_step: int,
    width: int,
    data: bytes | bytearray | memoryview,
    is_bigendian: bool = False,
) -> DipolePoints:
    """Read a field model cloud; `LayoutError` as `decode_flux`, and on values not finite."""
    records = _records(fields, point_step, width, data, is_bigendian)
    phasors = _phasors_of(records, 'm')
    values = _columns(records, ('x', 'y', 'z', 'ux', 'uy', 'uz', *phasors))
    if not np.isfinite(values).all():
        raise LayoutError('the field model holds values that are not finite')
    moments = np.ascontiguousarray(values[:, 6:]).view(np.complex128)
    return DipolePoints(values[:, :3], values[:, 3:6], moments)


def encode_field_model(points: DipolePoints) -> tuple[list[PointFieldTuple], int, bytes]:
    """Pack a field model cloud: fields, point_step and bytes."""
    count, n_emitters = points.moments.shape
    names = ['x', 'y', 'z', 'ux', 'uy', 'uz', *phasor_names('m', n_emitters)]
    values = np.empty((count, len(names)), dtype='<f8')
    values[:, :3], values[:, 3:6] = points.positions, points.directions
    values[:, 6::2], values[:, 7::2] = points.moments.real, points.moments.imag
    return *packed((name, FLOAT64) for name in names), values.tobytes()


MOST_VALUES = 50_000_000
"""Most values of modes that are unpacked, 400 MB; more means a damaged message."""
_HEAD = [('mode', '<u2'), ('dipole', '<u2'), ('flux_error', '<f4'), ('follows', '<u4'),
         ('withheld', '<u4')]  # fmt: skip


@dataclass(frozen=True)
class ModelError:
    """Holds the unexplained flux (T) and modes (R, N, K), complex, A m^2; R may be 0.

    ``follows`` says whether the model follows the references: each of their frames has its own.
    ``withheld`` is 0, or the code of the state for which the server withholds all poses.
    ``fingerprint`` is that of the model that the served one was made from, empty if unknown, and
    ``effects`` the number of its effects that a receiver has to undo.
    """

    flux_error_t: float
    modes: ComplexArray
    follows: bool = False
    withheld: int = 0
    fingerprint: str = ''
    effects: int = 0


def _layout(
    n_emitters: int, has_origin: bool = True
) -> tuple[list[PointFieldTuple], 'np.dtype[np.void]']:
    """Fields and record; what was recorded before 0.2 does not state which model it is from."""
    columns = [
        ('mode', UINT16), ('dipole', UINT16), ('flux_error', FLOAT32), ('follows', UINT32),
        ('withheld', UINT32), *((name, FLOAT32) for name in phasor_names('m', n_emitters)),
    ]  # fmt: skip
    record: list[Any] = [*_HEAD, ('m', '<f4', 2 * n_emitters)]
    if has_origin:
        columns += [('fingerprint', UINT32), ('effects', UINT32)]
        record += [('fingerprint', '<u4'), ('effects', '<u4')]
    return packed(columns)[0], np.dtype(record)


def encode_model_error(error: ModelError) -> tuple[list[PointFieldTuple], int, bytes]:
    """Pack a model's uncertainty: fields, point_step and bytes; `LayoutError` if too large."""
    modes = np.asarray(error.modes, dtype=np.complex128)
    if modes.ndim != 3 or max(modes.shape[:2]) > 0xFFFF:
        raise LayoutError(f'modes must be (R, N, K) with R, N below 65536, got {modes.shape}')
    fields, record = _layout(modes.shape[2])
    mode, dipole = np.nonzero((modes != 0.0).any(axis=2))
    if mode.size == 0:
        mode, dipole = np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp)
    out = np.zeros(mode.size, dtype=record)
    out['mode'], out['dipole'], out['flux_error'] = mode, dipole, error.flux_error_t
    out['follows'], out['withheld'] = error.follows, error.withheld
    out['fingerprint'], out['effects'] = int(error.fingerprint or '0', 16), error.effects
    if modes.shape[0]:
        chosen = modes[mode, dipole]
        out['m'][:, 0::2], out['m'][:, 1::2] = chosen.real, chosen.imag
    return fields, record.itemsize, out.tobytes()


def decode_model_error(
    fields: Sequence[PointFieldTuple],
    point_step: int,
    width: int,
    data: bytes | bytearray | memoryview,
    n_dipoles: int,
    n_emitters: int,
) -> ModelError:
    """Read the uncertainty of a model of so many dipoles and emitters; raises `LayoutError`."""
    has_origin = any(field[0] == 'fingerprint' for field in fields)
    wanted, record = _layout(n_emitters, has_origin)
    if list(fields) != wanted or point_step != record.itemsize:
        raise LayoutError(f'no model uncertainty for {n_emitters} emitters')
    if width < 1 or memoryview(data).nbytes != point_step * width:
        raise LayoutError(f'{width} points of {point_step} bytes do not fit the data')
    points = np.frombuffer(data, dtype=record, count=width)
    if int(points['dipole'].max()) >= n_dipoles:
        raise LayoutError(f'an uncertainty of dipole {points["dipole"].max()} of {n_dipoles}')
    if not (np.isfinite(points['m']).all() and np.isfinite(points['flux_error']).all()):
        raise LayoutError('the model uncertainty holds values that are not finite')
    flux_error = float(points['flux_error'][0])
    if flux_error < 0.0:
        raise LayoutError(f'the unexplained flux must not be negative, got {flux_error}')
    moments = points['m'][:, 0::2] + 1j * points['m'][:, 1::2]
    count = int(points['mode'].max()) + 1 if np.any(moments != 0.0) else 0
    if count * n_dipoles * n_emitters > MOST_VALUES:
        raise LayoutError(f'{count} modes of {n_dipoles} dipoles are too many')
    modes = np.zeros((count, n_dipoles, n_emitters), dtype=np.complex128)
    if count:
        modes[points['mode'], points['dipole']] = moments
    follows, withheld = bool(points['follows'][0]), int(points['withheld'][0])
    origin = int(points['fingerprint'][0]) if has_origin else 0
    effects = int(points['effects'][0]) if has_origin else 0
    named = f'{origin:0{DIGITS}x}' if origin else ''
    return ModelError(flux_error, modes, follows, withheld, named, effects)
