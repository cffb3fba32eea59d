"""Messages as bytes: too large ones never become objects, and poses read as what they say."""

from array import array

import numpy as np
import pytest
from conftest import spin_until
from geometry_msgs import msg
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import String

from anser_ros.errors import LayoutError
from anser_ros.nodes.pose_output import PackedMessage
from anser_ros.nodes.runtime import node, qos
from anser_ros.nodes.runtime.node import AnserNode, opened
from anser_ros.nodes.streams.clouds import flux_cloud
from anser_ros.wire.cdr import cloud_bytes, string_bytes
from anser_ros.wire.points import FLOAT32, MOST_POINTS, FluxPoints, encode_flux, flux_fields


def cloud(width=1, count=None, size=None):
    fields, step = flux_fields(8)
    if count is not None:
        fields, step = [(f'f{i}', 0, FLOAT32, 1) for i in range(count)], 4
    data = bytes(step * width if size is None else size)
    return cloud_bytes(7, 'fg', fields, step, width, data)


def test_a_message_within_its_bounds_is_opened():
    assert opened(string_bytes('a setup'), String).data == 'a setup'
    message = opened(cloud(9), PointCloud2)
    assert (message.width, len(message.fields), len(message.data)) == (9, 24, 9 * 92)


def test_what_is_too_large_is_refused_unopened(monkeypatch):
    monkeypatch.setattr(node, 'deserialize_message', None)  # would fail if it were called
    with pytest.raises(LayoutError, match='bytes is refused'):
        opened(string_bytes('x' * 1_000_001), String)
    with pytest.raises(LayoutError, match='bytes is refused'):
        opened(cloud(size=20_000_000), PointCloud2)
    with pytest.raises(LayoutError, match=f'a cloud of 1 x {MOST_POINTS + 1} points'):
        opened(cloud(MOST_POINTS + 1, size=8), PointCloud2)
    with pytest.raises(LayoutError, match='with 5000 fields is refused'):
        opened(cloud(count=5000), PointCloud2)


def test_a_node_counts_what_it_refuses_and_goes_on(ros):
    """Over DDS come a cloud of a million points, a huge text and a good one, which is taken."""

    class Taker(AnserNode):
        NAME = 'taker'

        def __init__(self):
            super().__init__()
            self.texts, self.clouds = [], []
            self.create_subscription(String, 'text', self._on_text, qos.STREAM)
            self.create_subscription(PointCloud2, 'cloud', self.clouds.append, qos.STREAM)

        def _on_text(self, message, info):
            self.texts.append((message.data, bool(info)))

    node, peer = Taker(), ros.create_node('peer', namespace='anser')
    text = peer.create_publisher(String, 'text', qos.STREAM)
    clouds = peer.create_publisher(PointCloud2, 'cloud', qos.STREAM)
    both = text, clouds
    assert spin_until(node, lambda: all(one.get_subscription_count() for one in both))
    clouds.publish(PointCloud2(height=1, width=10**6, point_step=1))
    text.publish(String(data='x' * 1_100_000))
    text.publish(String(data='good'))
    assert spin_until(node, lambda: node.texts and node.counters['refused_LayoutError'] == 2)
    assert node.texts == [('good', True)] and not node.clouds
    node.destroy_node()
    peer.destroy_node()


@pytest.mark.parametrize('frame_id', ['', 'fg', 'left_fg', 'boards/left/fg'])
@pytest.mark.parametrize('kind', ['PoseStamped', 'PoseWithCovarianceStamped'])
def test_a_packed_message_is_the_message(ros, kind, frame_id):
    """Whatever the length of the frame's name, which moves all that comes after it."""
    message_type = getattr(msg, kind)
    count = 7 if kind == 'PoseStamped' else 43
    told = message_type()
    told.header.frame_id = frame_id
    packer = PackedMessage(message_type, frame_id, count)
    for seed, stamp_ns in ((0, 5), (1, 1_795_419_147_667_697_521)):
        numbers = np.random.default_rng(seed).normal(size=count).tolist()
        told.header.stamp.sec, told.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        pose = told.pose if count == 7 else told.pose.pose
        place, turn = pose.position, pose.orientation
        place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = numbers[:7]
        if count > 7:
            told.pose.covariance = np.array(numbers[7:])
        assert deserialize_message(packer.packed(stamp_ns, *numbers), message_type) == told


@pytest.mark.parametrize('frame_id', ['', 'fg', 'boards/left/fg'])
def test_packed_fluxes_are_the_message(ros, frame_id):
    """Whichever topic a window is of, and whether its sensors move."""
    rng = np.random.default_rng(0)
    for seed, (sensors, emitters) in enumerate([(9, 8), (32, 8), (9, 8), (1, 3)]):
        flux = rng.normal(size=(sensors, emitters)) + 1j * rng.normal(size=(sensors, emitters))
        place = rng.normal(size=(sensors, 3)) * (np.nan if seed == 2 else 1.0)
        channel = np.arange(sensors)
        points = FluxPoints(channel, channel % 5, 1e-7 * flux, place, place)
        fields, step, data = encode_flux(points)
        told = PointCloud2(height=1, width=sensors, is_dense=seed != 2, point_step=step)
        told.header.frame_id, told.row_step, told.data = frame_id, len(data), array('B', data)
        told.header.stamp.sec, told.header.stamp.nanosec = 1_795_419_147, 667_697_521 + seed
        told.fields = [
            PointField(name=name, offset=offset, datatype=datatype, count=count)
            for name, offset, datatype, count in fields
        ]
        packed = flux_cloud(points, frame_id, 1_795_419_147_667_697_521 + seed)
        assert deserialize_message(packed, PointCloud2) == told
