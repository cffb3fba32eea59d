"""Lays out the bytes of a field model's uncertainty, which travels beside the model.

A point for every dipole that a mode moves: ``mode`` and ``dipole`` uint16, ``flux_error`` float32
(T: what the model leaves unexplained) and ``follows`` uint32 (1 while every frame of
``reference/flux`` is answered by a model of its stamp) and ``withheld`` uint32 (0, or the code of
the state for which no pose may be given), all three the same in all points; then ``m<k>_re``,
``m<k>_im`` float32 (A m^2), and, again the same in all points, ``fingerprint`` uint32 (of the
model that the served one was made from; 0 if unknown) and ``effects`` uint32 (of its effects, how
many a receiver has to undo). The moments are wrong by the sum of all modes, each times an
independent unit normal number. The message has the stamp of the ``field_model`` message that it
belongs to, and holds for later models of that size until there is another one: the uncertainty
changes less often than the field. A receiver that ignores this message still has the field.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import LayoutError
from anser_ros.fingerprint import DIGITS
from anser_ros.wire.points import FLOAT32, UINT16, UINT32, PointFieldTuple, packed, phasor_names

ComplexArray = NDArray[np.complex128]

MOST_VALUES = 50_000_000
"""Largest number of values of the modes that are unpacked, 400 MB; more means a damaged
message."""
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
    """Pack a model's uncertainty: fields, point_step and bytes.

    Raises
    ------
    LayoutError
        When there are more modes or dipoles than the layout can count.
    """
    modes = np.asarray(error.modes, dtype=np.complex128)
    if modes.ndim != 3 or max(modes.shape[:2]) > 0xFFFF:
        raise LayoutError(f'modes must be (R, N, K) with R, N below 65536, got {modes.shape}')
    fields, record = _layout(modes.shape[2])
    mode, dipole = np.nonzero(np.abs(modes).max(axis=2, initial=0.0))
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
    """Read the uncertainty of a model with so many dipoles and emitters.

    Raises
    ------
    LayoutError
        When the cloud is not laid out as `encode_model_error` does, names a dipole that the model
        doesn't have, or holds values that are not finite.
    """
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
