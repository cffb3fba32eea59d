"""Bags of others: all that can be read is read, and what cannot is said, whoever reads."""

import shutil
import sqlite3
import struct

import numpy as np
import pytest
import yaml
import zstandard
from conftest import REPO
from mcap.writer import Writer
from test_import_export import sqlite_bag

from anser_ros.cli.main import main
from anser_ros.errors import BagError
from anser_ros.wire.bag import RawMessage, Salvage, iter_messages, published_poses, read_bag
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.cdr import DEFINITIONS, HEADER, pose_bytes

START = 1_760_000_000_000_000_000
COUNT = 300
TOPIC = '/ndi/pen/pose'
MOVING = REPO / 'bags' / 'moving.mcap'
POSE_TYPE = 'geometry_msgs/msg/PoseStamped'


def pose(k):
    stamp = START + k * 20_000_000
    return pose_bytes(stamp, 'tracker', [0.001 * k, 0.02, 0.3], [0.0, 0.6, 0.0, 0.8])


def messages(count=COUNT):
    stamps = [START + k * 20_000_000 for k in range(count)]
    return [RawMessage(TOPIC, POSE_TYPE, s, pose(k), None, None) for k, s in enumerate(stamps)]


def mcap(path, rows, kind=POSE_TYPE, text='', form='ros2msg', encoding='cdr'):
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(kind, form, text.encode())
        channel = writer.register_channel(TOPIC, encoding, schema)
        for k, data in enumerate(rows):
            stamp = START + k * 20_000_000
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


def describe(folder, names, count):
    about = {'relative_file_paths': names, 'message_count': count}
    text = yaml.safe_dump({'rosbag2_bagfile_information': about})
    (folder / 'metadata.yaml').write_text(text)


def test_joined_files_are_read_one_after_the_other(tmp_path):
    """As `cat` joins them; also where both are alike, so that the index fits by chance."""
    rows = [pose(k) for k in range(COUNT)]
    first = mcap(tmp_path / 'a.mcap', rows[:100]).read_bytes()
    second = mcap(tmp_path / 'b.mcap', rows[100:]).read_bytes()
    both = tmp_path / 'both.MCAP'
    for parts, count in (((first, second), COUNT), ((first, first, first), 3 * 100)):
        both.write_bytes(b''.join(parts))
        salvage = Salvage()
        assert len(list(iter_messages(both, salvage))) == count
        assert f'{len(parts)} files are joined in both.MCAP' in salvage.lost
    both.write_bytes(first[:-20] + second)
    assert 'breaks off' not in read(both)[1] and '2 files are joined' in read(both)[1]
    both.write_bytes(first[: len(first) // 3] + second)
    assert 'breaks off' in read(both)[1] and '2 files are joined' in read(both)[1]


def read(path):
    salvage = Salvage()
    (poses,) = published_poses(path, salvage=salvage).values()
    return poses, salvage.lost


@pytest.mark.parametrize(
    ('text', 'form'),
    [('', 'ros2msg'), (POSE_TYPE, 'ros2msg'), ('module geometry_msgs {', 'ros2idl'), ('{}', '')],
)
def test_definitions_that_lack_are_those_of_the_package(tmp_path, text, form):
    path = mcap(tmp_path / 'a.mcap', [pose(k) for k in range(9)], text=text, form=form)
    poses, lost = read(path)
    np.testing.assert_allclose(poses.position[:, 0], 0.001 * np.arange(9))
    assert not lost


def test_a_session_without_any_definition_is_read(tmp_path):
    """Types of different topics that all have the same, empty text are not mixed up."""
    kinds, path = {}, tmp_path / 'a.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start()
        for raw in iter_messages(MOVING, Salvage()):
            if raw.topic not in kinds:
                schema = writer.register_schema(raw.type_name, 'ros2msg', b'')
                kinds[raw.topic] = writer.register_channel(raw.topic, 'cdr', schema)
            writer.add_message(kinds[raw.topic], raw.log_time_ns, raw.data, raw.log_time_ns)
        writer.finish()
    found, true = read_bag(path), read_bag(MOVING)
    np.testing.assert_array_equal(found.tool.flux, true.tool.flux)
    assert found.setup == true.setup and found.optical.keys() == true.optical.keys()


@pytest.mark.parametrize(
    ('kind', 'encoding', 'words'),
    [
        ('vendor/msg/Thing', 'cdr', f'there are: {TOPIC} (vendor/msg/Thing)'),
        *((POSE_TYPE, encoding, f'7 messages of {TOPIC} are {encoding.upper()}, not CDR')
          for encoding in ('json', 'protobuf', 'ros1')),
    ],
)  # fmt: skip
def test_what_cannot_be_decoded_is_named(tmp_path, kind, encoding, words, capsys):
    path = mcap(tmp_path / 'a.mcap', [b'\0\1\0\0'] * 7, kind=kind, encoding=encoding)
    for command in ('pivot', 'import --out', 'export --out'):
        name, *option = command.split()
        out = [*option, str(tmp_path / 'o.mcap')] if option else []
        assert main([name, str(path), *out]) == 2
        assert words in capsys.readouterr().err


class TestSqlite:
    def test_a_log_that_was_not_written_back_is_taken_in(self, tmp_path, capsys):
        """As a recorder that was killed leaves it: half of the messages are in the log."""
        source, bag = tmp_path / 'source.db3', tmp_path / 'bag'
        bag.mkdir()
        sqlite_bag(source, messages(COUNT // 2))
        base = sqlite3.connect(source)
        base.execute('PRAGMA journal_mode=WAL')
        base.execute('PRAGMA wal_autocheckpoint=0')
        for one in messages()[COUNT // 2 :]:
            row = (1, one.log_time_ns, one.data)
            base.execute('INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)', row)
        base.commit()
        for end in ('', '-wal'):
            shutil.copyfile(f'{source}{end}', bag / f'bag_0.db3{end}')
        base.close()
        describe(bag, ['bag_0.db3'], COUNT)
        before = (bag / 'bag_0.db3').read_bytes()
        poses, lost = read(bag)
        assert poses.stamp_ns.size == COUNT and not lost
        assert (bag / 'bag_0.db3').read_bytes() == before
        log, about = bag / 'bag_0.db3-wal', bag / 'metadata.yaml'
        whole, counts = log.read_bytes(), about.read_text()
        about.unlink()
        page = 24 + int.from_bytes(whole[8:12], 'big')
        for end in (-1, -page, len(whole) // 2):  # within a page, between two of one commit
            log.write_bytes(whole[:end])
            assert 'bag_0.db3-wal breaks off' in read(bag)[1]
        log.write_bytes(b'')
        assert not read(bag)[1], 'as a recorder leaves it that closed its file'
        about.write_text(counts)
        log.unlink()
        poses, lost = read(bag)
        assert poses.stamp_ns.size == COUNT // 2
        assert lost == '150 of the 300 messages that metadata.yaml counts are there'
        assert main(['import', str(bag), '--out', str(tmp_path / 'o.mcap')]) == 0
        assert lost in capsys.readouterr().err

    @pytest.mark.parametrize('share', [0.4, 0.7, 0.95])
    @pytest.mark.parametrize('with_index', [True, False])
    def test_a_file_that_was_cut(self, tmp_path, share, with_index):
        path = tmp_path / 'a.db3'
        sqlite_bag(path, messages())
        if with_index:  # as newer versions of rosbag2 make it
            base = sqlite3.connect(path)
            base.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
            base.commit()
            base.close()
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        poses, lost = read(path)
        count = poses.stamp_ns.size
        assert (0.6 * share - 0.2) * COUNT < count <= COUNT
        assert with_index or count < COUNT  # the end may hold the index alone
        assert f'{count} messages of a damaged file' in lost
        assert len(set(poses.stamp_ns.tolist())) == count
        np.testing.assert_allclose(poses.position[:, 0] * 2e10, poses.stamp_ns - START, atol=1)

    def test_damage_in_the_middle_loses_only_the_middle(self, tmp_path):
        path = tmp_path / 'a.db3'
        sqlite_bag(path, messages())
        data = bytearray(path.read_bytes())
        data[4096 * 6 : 4096 * 7] = bytes(4096)
        path.write_bytes(data)
        poses, lost = read(path)
        assert COUNT - 60 < poses.stamp_ns.size < COUNT and 'damaged' in lost
        assert poses.stamp_ns[0] == START and poses.stamp_ns[-1] == START + 299 * 20_000_000


class TestFolders:
    @pytest.fixture
    def bag(self, tmp_path):
        folder = tmp_path / 'bag'
        folder.mkdir()
        for number in range(3):
            rows = [pose(k) for k in range(100 * number, 100 * number + 100)]
            mcap(folder / f'bag_{number}.mcap', rows)
        describe(folder, [f'bag_{n}.mcap' for n in range(3)], COUNT)
        return folder

    @pytest.mark.parametrize('text', [None, '', '\0' * 600, 'a: [', '- 1', 'whole'])
    def test_split_files_are_one_bag_whatever_describes_them(self, bag, text):
        if text is None:
            (bag / 'metadata.yaml').unlink()
        elif text != 'whole':
            (bag / 'metadata.yaml').write_text(text)
        poses, lost = read(bag)
        assert poses.stamp_ns.tolist() == [START + k * 20_000_000 for k in range(COUNT)]
        assert ('metadata.yaml cannot be read' in lost) == (text not in (None, 'whole'))
        assert ('3 files are joined without metadata.yaml' in lost) == (text is None)

    @pytest.mark.parametrize('damage', ['missing', 'empty', 'cut', 'no bag', 'packed and cut'])
    def test_a_file_that_is_not_whole_costs_no_other(self, bag, damage):
        path = bag / 'bag_1.mcap'
        data = path.read_bytes()
        path.unlink()
        if damage == 'packed and cut':
            packed = zstandard.ZstdCompressor().compress(data)
            (bag / 'bag_1.mcap.zstd').write_bytes(packed[: len(packed) // 2])
        elif damage != 'missing':
            path.write_bytes({'empty': b'', 'cut': data[:500], 'no bag': b'hello' * 9}[damage])
        poses, lost = read(bag)
        assert poses.stamp_ns.size == 200
        assert 'bag_1.mcap' in lost or 'breaks off' in lost
        assert '200 of the 300 messages' in lost

    def test_nothing_left_is_an_error(self, bag):
        for file in bag.glob('*.mcap'):
            file.write_bytes(b'')
        with pytest.raises(BagError, match='no message can be read'):
            read(bag)


def header(k):
    return struct.pack('<iII8s', START // 10**9, 20_000_000 * k, 8, b'tracker\0')


def odometry(k, kind):
    """Bodies of other types, as ROS serialises them; all of their strings end aligned to eight."""
    numbers = struct.pack('<7d', 0.001 * k, 0.02, 0.3, 0.0, 0.6, 0.0, 0.8)
    child = struct.pack('<I4s', 4, b'pen\0')
    if kind == 'tf2_msgs/msg/TFMessage':
        return HEADER + struct.pack('<I', 1) + header(k) + child + numbers
    tail = bytes(36 * 8) if 'Covariance' in kind else b''
    if kind == 'nav_msgs/msg/Odometry':
        tail = bytes(36 * 8 + 6 * 8 + 36 * 8)
    if 'Covariance' in kind:
        return HEADER + header(k) + bytes(4) + numbers + tail
    return HEADER + header(k) + child + bytes(4) + numbers + tail


POSE_KINDS = [
    kind for kind in DEFINITIONS if kind.split('/')[0] not in ('std_msgs', 'sensor_msgs')
]


@pytest.mark.parametrize('kind', POSE_KINDS)
def test_poses_of_every_type(tmp_path, kind):
    """The one child of `/tf` is a topic of its own."""
    rows = [pose(k) if kind == POSE_TYPE else odometry(k, kind) for k in range(40)]
    path = mcap(tmp_path / 'a.mcap', rows, kind=kind)
    found = published_poses(path)
    assert list(found) == [f'{TOPIC}/pen' if '/TF' in kind else TOPIC]
    (poses,) = found.values()
    np.testing.assert_allclose(poses.position, [[0.001 * k, 0.02, 0.3] for k in range(40)])
    np.testing.assert_allclose(poses.quaternion, [[0.0, 0.6, 0.0, 0.8]] * 40)
    assert poses.stamp_ns.tolist() == [START + k * 20_000_000 for k in range(40)]


def test_other_types_do_not_count_beside_plain_poses(tmp_path):
    path = tmp_path / 'a.mcap'
    kind = 'geometry_msgs/msg/PoseWithCovarianceStamped'
    with SessionWriter(path) as writer:
        for k in range(9):
            channel = writer.channel('/pen/pose_with_covariance', kind, DEFINITIONS[kind])
            writer.write(channel, START + k, odometry(k, kind))
            writer.write_pose('/pen/pose', START + k, [0, 0, 0], [0, 0, 0, 1])
    assert list(published_poses(path)) == ['/pen/pose']
    (named,) = published_poses(path, ['/pen/pose_with_covariance']).values()
    assert named.stamp_ns.size == 9
