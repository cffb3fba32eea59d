"""Packs and reads messages of OpenIGTLink 3: poses that are sent, clients' requests.

Layouts as in openigtlink.org/developers/spec: big-endian, mm, CRC-64 of ECMA-182. Header version 1
is what the oldest clients read; version 2 adds metadata.
"""

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.errors import ParameterError

NAME_BYTES = 20
"""Bytes that a header has for the device's name."""
MM_PER_M = 1e3
"""OpenIGTLink has millimetres."""
ASCII = 3
"""Number of that character set at IANA, by which texts are marked."""
OK, NOT_READY = 1, 13
"""Codes of STATUS: all is well; the device is there but has nothing to give."""
SIX_DOF = 2
"""TDATA's number of an instrument that is tracked in six degrees of freedom."""
CAPABILITIES = ('TRANSFORM', 'STRING', 'STATUS', 'CAPABILITY', 'TDATA')
"""Messages that the server sends."""
TRANSFORM_STATUS = 'TransformStatus'
"""Key of the metadata that say whether a pose may be used."""
_HEADER = struct.Struct('>H12s20sIIQQ')
HEADER_BYTES = _HEADER.size
_VERSIONS = (1, 2, 3)
"""Versions of headers that there are."""
_POLYNOMIAL, _MASK = 0x42F0E1EBA9EA3693, 2**64 - 1  # CRC-64, ECMA-182


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = ((value << 1) & _MASK) ^ (_POLYNOMIAL if value >> 63 else 0)
        table.append(value)
    return tuple(table)


_TABLE = _crc_table()


class Header(NamedTuple):
    """Holds what stands before a message: version, type, device, and the length of its body."""

    version: int
    kind: str
    device: str
    body_bytes: int


class Tracked(NamedTuple):
    """Holds one instrument of TDATA: name, position, m, and quaternion x y z w."""

    name: str
    position_m: Sequence[float]
    quaternion_xyzw: Sequence[float]


def crc64(data: bytes) -> int:
    value = 0
    for byte in data:
        value = _TABLE[(value >> 56) ^ byte] ^ ((value << 8) & _MASK)
    return value


def read_header(data: bytes) -> Header | None:
    """Return the header in the first `HEADER_BYTES` bytes; None where they are none."""
    version, kind, device, _, _, size, _ = _HEADER.unpack(data[:HEADER_BYTES])
    if version not in _VERSIONS or not kind.strip(b'\0').isascii():
        return None
    words = [text.split(b'\0')[0].decode('ascii', 'replace') for text in (kind, device)]
    return Header(version, words[0], words[1], size)


def resolution_s(header: Header, body: bytes) -> float:
    """Return the time between two TDATA that a client asked for, s; 0 for as often as possible."""
    content = body[12:] if header.version > 1 else body  # behind the extended header
    if len(content) < 4:
        return 0.0
    return max(int.from_bytes(content[:4], signed=True), 0) / 1e3


def device_names(named: Mapping[str, str]) -> dict[str, str]:
    """Return the device of each name; one too long for the protocol loses its beginning.

    Raises `ParameterError` when one is empty or not ASCII, or two devices, or a device and the
    state of another, have the same name.
    """
    devices = {name: text[-NAME_BYTES:] for name, text in named.items()}
    owners: dict[str, str] = {}
    for name, device in devices.items():
        if not device or not device.isascii():
            raise ParameterError(
                f'{name}: {device!r} cannot be the name of a device, which is in ASCII'
            )
        for known in (device, state_device(device)):
            if known in owners:
                raise ParameterError(
                    f'{owners[known]} and {name} both become the device {known!r}, as names are '
                    f'cut to {NAME_BYTES} characters; a template can shorten them'
                )
            owners[known] = name
    return devices


def state_device(device: str) -> str:
    """Return the name of the device that reports the state of another one."""
    return (device + '/state')[-NAME_BYTES:]


def message(
    kind: str,
    device: str,
    stamp_s: float,
    content: bytes,
    metadata: Mapping[str, str] | None = None,
) -> bytes:
    """Pack a message; with metadata, even if none, it has a header of version 2."""
    body = content
    if metadata is not None:
        index, texts = struct.pack('>H', len(metadata)), b''
        for key, value in metadata.items():
            words = key.encode('ascii', 'replace'), value.encode('ascii', 'replace')
            index += struct.pack('>HHI', len(words[0]), ASCII, len(words[1]))
            texts += words[0] + words[1]
        body = struct.pack('>HHII', 12, len(index), len(texts), 0) + content + index + texts
    whole = int(stamp_s)
    return (
        _HEADER.pack(
            1 if metadata is None else 2, kind.encode('ascii'), device.encode('ascii', 'replace'),
            whole, int((stamp_s - whole) * 2**32) & 0xFFFFFFFF, len(body), crc64(body),
        )
        + body
    )  # fmt: skip


def _matrix(position_m: Sequence[float], quaternion_xyzw: Sequence[float]) -> bytes:
    turn = Rotation.from_quat(quaternion_xyzw).as_matrix()
    columns = np.concatenate([turn.T.ravel(), MM_PER_M * np.asarray(position_m)])
    packed: bytes = columns.astype('>f4').tobytes()
    return packed


def transform(
    device: str,
    stamp_s: float,
    position_m: Sequence[float],
    quaternion_xyzw: Sequence[float],
    version: int,
) -> bytes:
    """Pack a pose, shape (3,), m, and (4,), x y z w, that may be used: TransformStatus is OK."""
    metadata = {TRANSFORM_STATUS: 'OK'} if version > 1 else None
    return message('TRANSFORM', device, stamp_s, _matrix(position_m, quaternion_xyzw), metadata)


def string(device: str, stamp_s: float, text: str) -> bytes:
    words = text.encode('ascii', 'replace')
    return message('STRING', device, stamp_s, struct.pack('>HH', ASCII, len(words)) + words)


def status(device: str, stamp_s: float, code: int, name: str, text: str) -> bytes:
    """Pack a STATUS: code, a word for the state, and the reason."""
    words = text.encode('ascii', 'replace') + b'\0'
    content = struct.pack('>Hq20s', code, 0, name.encode('ascii', 'replace')[:NAME_BYTES]) + words
    return message('STATUS', device, stamp_s, content)


def capability(stamp_s: float) -> bytes:
    return message(
        'CAPABILITY', '', stamp_s, b''.join(struct.pack('12s', k.encode()) for k in CAPABILITIES)
    )


def tracking_reply(stamp_s: float) -> bytes:
    """Pack that TDATA will be sent, or are no longer, as was asked."""
    return message('RTS_TDATA', '', stamp_s, b'\0')


def tracking(stamp_s: float, instruments: Sequence[Tracked]) -> bytes:
    content = b''.join(
        struct.pack('>20sBB', one.name.encode('ascii', 'replace')[:NAME_BYTES], SIX_DOF, 0)
        + _matrix(one.position_m, one.quaternion_xyzw)
        for one in instruments
    )
    return message('TDATA', '', stamp_s, content)
