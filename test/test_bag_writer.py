"""Bags written without ROS: readable, complete after a full disk, and honest in their metadata."""

import errno
import io

import numpy as np
import pytest
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from anser_ros.errors import BagError
from anser_ros.wire import cdr
from anser_ros.wire.bag_writer import (
    BagRecord,
    BagWriter,
    SessionWriter,
    TopicRecord,
    qos_profile,
    write_metadata,
)
from anser_ros.wire.points import STALE, decode_flux
from anser_ros.wire.setup import SensorSpec

FIELDS = [('x', 0, 7, 1), ('channel', 4, 4, 1), ('flags', 6, 4, 1)]
STAMP_NS = 1_750_000_000_123_456_789


def decoded(path):
    from mcap_ros2.decoder import DecoderFactory

    with open(path, 'rb') as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(c.topic, m.log_time, d) for _, c, m, d in reader.iter_decoded_messages()]


class TestSession:
    def test_reads_back_as_written(self, tmp_path):
        path = tmp_path / 'new' / 'session.mcap'
        data = bytes(range(16))
        with SessionWriter(path) as session:
            session.write_setup('schema: anser_setup/1\n', STAMP_NS)
            session.write_flux('/anser/tool/flux', STAMP_NS, FIELDS, 8, 2, data)
            pose = ('/optical/tool_a/pose', STAMP_NS, np.array([0.1, 0.2, 0.3]), (0, 0, 0, 1))
            session.write_pose(*pose)
        messages = {topic: (log_time, message) for topic, log_time, message in decoded(path)}
        assert all(log_time == STAMP_NS for log_time, _ in messages.values())
        assert messages['/anser/setup'][1].data == 'schema: anser_setup/1\n'
        cloud = messages['/anser/tool/flux'][1]
        assert (cloud.header.stamp.sec, cloud.header.stamp.nanosec) == divmod(STAMP_NS, 10**9)
        assert (cloud.header.frame_id, cloud.height, cloud.width) == ('fg', 1, 2)
        assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == FIELDS
        assert (cloud.point_step, cloud.row_step, bytes(cloud.data)) == (8, 16, data)
        assert messages['/optical/tool_a/pose'][1].pose.position.y == 0.2

    @pytest.mark.parametrize('error', [ValueError, KeyboardInterrupt])
    def test_a_session_that_is_not_finished_leaves_no_file(self, tmp_path, error):
        path = tmp_path / 'half.mcap'
        with pytest.raises(error), SessionWriter(path) as session:
            session.write_setup('schema: anser_setup/1\n', STAMP_NS)
            raise error
        assert not path.exists()

    def test_a_sensor_without_a_reading_is_stale_and_an_emitter_without_current_is_not(
        self, tmp_path
    ):
        sensors = [SensorSpec(c, f's/{c}', 'tool', (0, 0, 0), (0, 0, 1), 0.0) for c in (3, 1, 2)]
        fixed = SensorSpec(7, 'r/7', 'fg', (0.1, 0.2, 0.3), (1.0, 0.0, 0.0), 0.0)
        flux = np.full((4, 3), 1e-6 + 1e-7j)
        flux[:3, 1] = np.nan  # the emitter
        flux[1, 2] = flux[3] = np.nan  # one reading, and all of the reference's
        path = tmp_path / 'a.mcap'
        with SessionWriter(path) as session:
            session.write_readings([*sensors, fixed], STAMP_NS, flux)
        points = {
            topic: decode_flux(
                [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields],
                cloud.point_step, cloud.width, bytes(cloud.data),
            )
            for topic, _, cloud in decoded(path)
        }  # fmt: skip
        tools, references = points['/anser/tool/flux'], points['/anser/reference/flux']
        assert tools.channel.tolist() == [3, 1, 2]
        assert tools.flags.tolist() == [0, STALE, 0]
        assert np.isnan(tools.position).all()
        assert references.flags.tolist() == [STALE]
        np.testing.assert_allclose(references.position[0], fixed.position_m, rtol=1e-6)

    def test_refuses_to_write_over_a_bag_and_into_a_folder_that_is_none(self, tmp_path):
        SessionWriter(tmp_path / 'a.mcap').close()
        with pytest.raises(BagError, match='already exists'):
            SessionWriter(tmp_path / 'a.mcap')
        (tmp_path / 'file').write_text('')
        with pytest.raises(BagError, match='file'):
            SessionWriter(tmp_path / 'file' / 'a.mcap')


class TestCdr:
    """ROS reads the bytes as what was meant, for any length of the texts before them."""

    @pytest.mark.parametrize('frame', ['', 'fg', 'fgx', 'abcd', 'abcde'])
    def test_rclpy_reads_them(self, frame):
        from geometry_msgs.msg import PoseStamped
        from rclpy.serialization import deserialize_message, serialize_message
        from sensor_msgs.msg import PointCloud2, PointField
        from std_msgs.msg import String

        def agree(ours, message):
            # Padding is whatever lay in ROS's memory, so lengths and contents are compared.
            assert len(ours) == len(serialize_message(message))
            assert deserialize_message(ours, type(message)) == message

        agree(cdr.string_bytes(frame), String(data=frame))
        pose = PoseStamped()
        pose.header.frame_id = frame
        pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(STAMP_NS, 10**9)
        pose.pose.position.z = 0.25
        ours = cdr.pose_bytes(STAMP_NS, frame, (0.0, 0.0, 0.25), (0.0, 0.0, 0.0, 1.0))
        agree(ours, pose)
        cloud = PointCloud2(height=1, width=3, point_step=8, row_step=24, is_dense=False)
        cloud.header = pose.header
        cloud.data.frombytes(bytes(24))
        for name, offset, datatype, count in FIELDS:
            field = PointField(name=name, offset=offset, datatype=datatype, count=count)
            cloud.fields.append(field)
        ours = cdr.cloud_bytes(STAMP_NS, frame, FIELDS, 8, 3, bytes(24))
        agree(ours, cloud)


class FullDisk(io.BytesIO):
    """Takes a number of bytes, and half of the write that goes beyond, like a file does."""

    def __init__(self, room):
        super().__init__()
        self.room = room

    def write(self, data):
        left = self.room - self.tell()
        if len(data) > left > 0:
            return super().write(data[: max(left // 2, 1)])
        if len(data) > left:
            raise OSError(errno.ENOSPC, 'No space left on device')
        return super().write(data)

    def close(self):
        self.kept = self.getvalue()
        super().close()


class TestFullDisk:
    def fill(self, disk):
        rng = np.random.default_rng(1)
        bag = BagWriter('full.mcap', raw=disk)
        channel = bag.add_topic('/s', 'std_msgs/msg/String', 'string data\n')
        for n in range(1000):
            bag.write(channel, n, cdr.string_bytes(rng.bytes(3000).hex()))
            try:
                bag.flush()
            except OSError as error:
                assert error.errno == errno.ENOSPC
                return bag, n
        raise AssertionError('the disk never filled up')

    def test_kept_space_makes_the_bag_complete(self):
        disk = FullDisk(100_000)
        bag, last = self.fill(disk)
        disk.room += 1_000_000  # what closing frees
        bag.close()
        assert not bag.is_open
        reader = make_reader(io.BytesIO(disk.kept), validate_crcs=True)
        assert [m.log_time for _, _, m in reader.iter_messages()] == list(range(last + 1))

    def test_without_any_space_whole_chunks_remain(self):
        disk = FullDisk(100_000)
        bag, last = self.fill(disk)
        with pytest.raises(OSError, match='No space'):
            bag.close()
        assert not bag.is_open
        bag.close()
        count = 0
        with pytest.raises(EndOfFile):
            for record in StreamReader(io.BytesIO(disk.kept), validate_crcs=True).records:
                count += type(record).__name__ == 'Message'
        assert count == last


def test_metadata_is_what_rosbag2_reads(tmp_path):
    qos = [qos_profile(latched=True)]
    topic = TopicRecord('/anser/setup', 'std_msgs/msg/String', 'RIHS01_00', qos, 3)
    write_metadata(tmp_path, {'a_0.mcap': BagRecord({1: topic}, 3, 100, 600)}, 'jazzy')
    text = (tmp_path / 'metadata.yaml').read_text()
    assert '&' not in text
    info = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert info['version'] == 9 and info['storage_identifier'] == 'mcap'
    assert info['relative_file_paths'] == ['a_0.mcap']
    assert info['duration']['nanoseconds'] == 500 and info['message_count'] == 3
    (only,) = info['topics_with_message_count']
    assert only['message_count'] == 3
    (profile,) = only['topic_metadata']['offered_qos_profiles']
    assert profile['durability'] == 'transient_local' and profile['history'] == 'keep_last'
    assert only['topic_metadata']['type_description_hash'] == 'RIHS01_00'


class TestIndex:
    TOPICS, FLUSHES, PERIOD_NS = 40, 64, 250_000_000

    def record(self, path):
        """Write a quarter of a minute, and return the file's bytes after every flush."""
        states = []
        with BagWriter(path) as bag:
            for k in range(self.FLUSHES):
                if k in (0, 3):  # half of the topics appear later
                    half = range(k and self.TOPICS // 2, self.TOPICS // (1 if k else 2))
                    for n in half:
                        bag.add_topic(f'/t{n}', 'std_msgs/msg/String', '')
                for channel in bag.record.topics:
                    time_ns = STAMP_NS + k * self.PERIOD_NS
                    bag.write(channel, time_ns, cdr.string_bytes(str(k)))
                bag.flush()
                states.append((bag.record.messages, path.read_bytes()))
        return states

    def test_is_whole_and_of_few_chunks(self, tmp_path):
        path = tmp_path / 'long.mcap'
        self.record(path)
        with open(path, 'rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            chunks = summary.chunk_indexes
            assert len(chunks) == summary.statistics.chunk_count <= 6
            assert set(chunks[-1].message_index_offsets) == set(range(1, self.TOPICS + 1))
            found = [message.data for _, _, message in reader.iter_messages(['/t7'])]
            assert found == [cdr.string_bytes(str(k)) for k in range(self.FLUSHES)]

    def test_every_flush_leaves_a_file_with_all_messages(self, tmp_path):
        for count, data in self.record(tmp_path / 'long.mcap'):
            messages = set()
            with pytest.raises(EndOfFile):
                for record in StreamReader(io.BytesIO(data), validate_crcs=True).records:
                    if type(record).__name__ == 'Message':
                        messages.add((record.channel_id, record.log_time))
            assert len(messages) == count
