"""Serialises the three message types that a session is made of, and reads clouds, without ROS.

Plain CDR, little endian: a value lies at a multiple of its own size, counted from the byte after
the four-byte header; a string or a sequence is its length as uint32 and then its items.

Results equal those of mcap-ros2-support's encoder byte for byte, which is only in a writer that
neither stores QoS profiles nor ends a chunk when asked.

Source: OMG Common Data Representation, as DDS-XTypes 1.3 (section 7.4.1) takes it over.
"""

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from anser_ros.errors import LayoutError
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.points import MOST_POINTS, PointFieldTuple

HEADER = b'\x00\x01\x00\x00'

_TYPES = {
    'std_msgs/String': 'string data',
    'std_msgs/Header': 'builtin_interfaces/Time stamp, string frame_id',
    'builtin_interfaces/Time': 'int32 sec, uint32 nanosec',
    'sensor_msgs/PointCloud2': 'std_msgs/Header header, uint32 height, uint32 width, '
    'PointField[] fields, bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, '
    'bool is_dense',
    'sensor_msgs/PointField': 'string name, uint32 offset, uint8 datatype, uint32 count',
    'geometry_msgs/Point': 'float64 x, float64 y, float64 z',
    'geometry_msgs/Vector3': 'float64 x, float64 y, float64 z',
    'geometry_msgs/Quaternion': 'float64 x, float64 y, float64 z, float64 w',
    'geometry_msgs/Pose': 'Point position, Quaternion orientation',
    'geometry_msgs/PoseStamped': 'std_msgs/Header header, Pose pose',
    'geometry_msgs/PoseWithCovariance': 'Pose pose, float64[36] covariance',
    'geometry_msgs/PoseWithCovarianceStamped': 'std_msgs/Header header, PoseWithCovariance pose',
    'geometry_msgs/Transform': 'Vector3 translation, Quaternion rotation',
    'geometry_msgs/TransformStamped': 'std_msgs/Header header, string child_frame_id, '
    'Transform transform',
    'geometry_msgs/Twist': 'Vector3 linear, Vector3 angular',
    'geometry_msgs/TwistWithCovariance': 'Twist twist, float64[36] covariance',
    'tf2_msgs/TFMessage': 'geometry_msgs/TransformStamped[] transforms',
    'nav_msgs/Odometry': 'std_msgs/Header header, string child_frame_id, '
    'geometry_msgs/PoseWithCovariance pose, geometry_msgs/TwistWithCovariance twist',
}
"""Fields of types."""


def _definition(name: str) -> str:
    """The fields of a type, and of all types in it."""
    parts, names = list[str](), [name]
    for current in names:  # which grows meanwhile
        fields = _TYPES[current].split(', ')
        title = [f'\n{80 * "="}\nMSG: {current}'] if parts else []
        parts += [*title, *fields]
        for kind in (field.split()[0].partition('[')[0] for field in fields):
            whole = kind if '/' in kind else f'{current.split("/")[0]}/{kind}'
            names += [whole] if whole in _TYPES and whole not in names else []
    return '\n'.join([*parts, ''])


DEFINITIONS = {
    name.replace('/', '/msg/'): _definition(name)
    for name in _TYPES if name.endswith(('String', 'Cloud2', 'Stamped', 'TFMessage', 'Odometry'))
}  # fmt: skip
"""Definitions of whole messages, in the form in which MCAP carries them (`ros2msg`)."""


class _Bytes:
    """Appends aligned values."""

    def __init__(self) -> None:
        self.body = bytearray()

    def add(self, code: str, *values: float) -> None:
        size = struct.calcsize(f'<{code}')
        self.body += bytes(-len(self.body) % size)
        self.body += struct.pack(f'<{len(values)}{code}', *values)

    def text(self, value: str) -> None:
        encoded = value.encode() + b'\0'
        self.add('I', len(encoded))
        self.body += encoded

    def header(self, stamp_ns: int, frame_id: str) -> None:
        self.add('i', stamp_ns // SECOND_NS)
        self.add('I', stamp_ns % SECOND_NS)
        self.text(frame_id)

    def done(self) -> bytes:
        return HEADER + bytes(self.body)


def string_bytes(text: str) -> bytes:
    """Return a serialised ``std_msgs/String``."""
    out = _Bytes()
    out.text(text)
    return out.done()


def pose_bytes(
    stamp_ns: int, frame_id: str, position: Sequence[float], quaternion_xyzw: Sequence[float]
) -> bytes:
    """Serialise a ``geometry_msgs/PoseStamped``; the position in m."""
    out = _Bytes()
    out.header(stamp_ns, frame_id)
    x, y, z = position
    qx, qy, qz, qw = quaternion_xyzw
    out.add('d', x, y, z, qx, qy, qz, qw)
    return out.done()


@lru_cache(maxsize=32)
def _fields_bytes(fields: tuple[PointFieldTuple, ...]) -> bytes:
    """Serialise the fields of a cloud and its byte order, which begin and end at a whole word."""
    out = _Bytes()
    out.add('I', len(fields))
    for name, offset, datatype, count in fields:
        out.text(name)
        out.add('I', offset)
        out.add('B', datatype)
        out.add('I', count)
    out.add('B', 0)
    return bytes(out.body) + bytes(-len(out.body) % 4)


def cloud_bytes(
    stamp_ns: int,
    frame_id: str,
    fields: Sequence[PointFieldTuple],
    point_step: int,
    width: int,
    data: bytes,
    is_dense: bool = False,
) -> bytes:
    """Serialise a ``sensor_msgs/PointCloud2`` of height 1.

    It is dense where no value is NaN; the position of a tool sensor is.
    """
    out = _Bytes()
    out.header(stamp_ns, frame_id)
    out.add('I', 1, width)
    out.body += _fields_bytes(tuple(fields))
    out.add('I', point_step, point_step * width, len(data))
    out.body += data
    out.add('B', is_dense)
    return out.done()


MOST_FIELDS = 4096
"""Most fields of a cloud, which is one of 2000 emitters: each is an object to be made."""


class Stamp(NamedTuple):
    """Holds a time as ``builtin_interfaces/Time`` does: seconds, and nanoseconds beyond them."""

    sec: int
    nanosec: int


class CloudHeader(NamedTuple):
    """Holds stamp and frame as ``std_msgs/Header`` does."""

    stamp: Stamp
    frame_id: str


class PointCloud(NamedTuple):
    """Holds a ``sensor_msgs/PointCloud2`` by the names that it has there; fields are tuples."""

    header: CloudHeader
    height: int
    width: int
    fields: list[PointFieldTuple]
    is_bigendian: bool
    point_step: int
    data: memoryview


def read_cloud(message: bytes) -> PointCloud:
    """Read a serialised cloud, a fifth of the work that the middleware's object takes.

    Raises `LayoutError` when it is none, or has more points or fields than a sensible one.
    """
    order = '<' if message[1:2] == b'\x01' else '>'
    body = memoryview(message)[len(HEADER) :]
    word, kind = struct.Struct(f'{order}I').unpack_from, struct.Struct(f'{order}IBxxxI')
    try:
        sec, nanosec, size = struct.unpack_from(f'{order}iII', body)
        frame_id, place = _text(body, 12, size)
        height, width, count = struct.unpack_from(f'{order}III', body, place)
        if height * width > MOST_POINTS or count > MOST_FIELDS:
            raise LayoutError(
                f'a cloud of {height} x {width} points with {count} fields is refused, '
                f'the most is {MOST_POINTS} with {MOST_FIELDS}'
            )
        fields, place = list[PointFieldTuple](), place + 12
        for _ in range(count):
            name, place = _text(body, place + 4, word(body, place)[0])
            fields.append((name, *kind.unpack_from(body, place)))
            place += kind.size
        is_bigendian = bool(body[place])
        step, _, size = struct.unpack_from(f'{order}III', body, place + 4)
        data = body[place + 16 : place + 16 + size]
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise LayoutError(f'no cloud in {len(message)} bytes') from error
    if len(data) < size:
        raise LayoutError(f'a cloud of {size} bytes ends after {len(data)}')
    header = CloudHeader(Stamp(sec, nanosec), frame_id)
    return PointCloud(header, height, width, fields, is_bigendian, step, data)


def _text(body: memoryview, place: int, size: int) -> tuple[str, int]:
    """Return a string of so many bytes, its end included, and the place of the next word."""
    end = place + size
    return str(body[place : end - 1], 'utf-8'), end + -end % 4
