"""Serialises the three message types that a session is made of, without ROS.

Plain CDR, little endian: a value lies at a multiple of its own size, counted from the byte after
the four-byte header; a string or a sequence is its length as uint32 and then its items.

Results equal those of mcap-ros2-support's encoder byte for byte, which is only in a writer that
neither stores QoS profiles nor ends a chunk when asked.

Source: OMG Common Data Representation, as DDS-XTypes 1.3 (section 7.4.1) takes it over.
"""

import struct
from collections.abc import Sequence
from functools import lru_cache

from anser_ros.errors import LayoutError
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.points import PointFieldTuple

HEADER = b'\x00\x01\x00\x00'

_HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id

================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_PARTS = {
    'Pose': 'Point position\nQuaternion orientation\n',
    'Point': 'float64 x\nfloat64 y\nfloat64 z\n',
    'Vector3': 'float64 x\nfloat64 y\nfloat64 z\n',
    'Quaternion': 'float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n',
    'PoseWithCovariance': 'Pose pose\nfloat64[36] covariance\n',
    'TwistWithCovariance': 'Twist twist\nfloat64[36] covariance\n',
    'Twist': 'Vector3 linear\nVector3 angular\n',
    'Transform': 'Vector3 translation\nQuaternion rotation\n',
    'TransformStamped': 'std_msgs/Header header\nstring child_frame_id\nTransform transform\n',
}


def _definition(fields: str, *parts: str) -> str:
    """The definition of a type with types of geometry_msgs in it."""
    inner = (f'\n{80 * "="}\nMSG: geometry_msgs/{part}\n{_PARTS[part]}' for part in parts)
    return ''.join([fields, *inner, _HEADER])


# Field lists of the types, in the form in which MCAP carries definitions (`ros2msg`).
DEFINITIONS = {
    'std_msgs/msg/String': 'string data\n',
    'sensor_msgs/msg/PointCloud2': f"""std_msgs/Header header
uint32 height
uint32 width
PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense

================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
{_HEADER}""",
    'geometry_msgs/msg/PoseStamped': _definition(
        'std_msgs/Header header\nPose pose\n', 'Pose', 'Point', 'Quaternion'
    ),
    'geometry_msgs/msg/PoseWithCovarianceStamped': _definition(
        'std_msgs/Header header\nPoseWithCovariance pose\n',
        'PoseWithCovariance', 'Pose', 'Point', 'Quaternion',
    ),
    'geometry_msgs/msg/TransformStamped': _definition(
        _PARTS['TransformStamped'], 'Transform', 'Vector3', 'Quaternion'
    ),
    'tf2_msgs/msg/TFMessage': _definition(
        'geometry_msgs/TransformStamped[] transforms\n',
        'TransformStamped', 'Transform', 'Vector3', 'Quaternion',
    ),
    'nav_msgs/msg/Odometry': _definition(
        'std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n'
        'geometry_msgs/TwistWithCovariance twist\n',
        'PoseWithCovariance', 'Pose', 'Point', 'Quaternion', 'TwistWithCovariance', 'Twist',
        'Vector3',
    ),
}  # fmt: skip


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


def cloud_head(data: bytes) -> tuple[int, int, int]:
    """Return height, width and fields of a serialised cloud alone; raises `LayoutError`."""
    order = '<' if data[1:2] == b'\x01' else '>'
    body = memoryview(data)[len(HEADER) :]
    try:
        (length,) = struct.unpack_from(f'{order}I', body, 8)
        place = 12 + length
        height, width, fields = struct.unpack_from(f'{order}III', body, place + -place % 4)
    except struct.error as error:
        raise LayoutError(f'no cloud in {len(data)} bytes') from error
    return height, width, fields
