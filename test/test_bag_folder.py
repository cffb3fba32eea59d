"""Bags of several files, and the ring of the last minute that snapshots are made of."""

import pytest
import yaml

from anser_ros.wire.bag import Salvage, iter_messages
from anser_ros.wire.bag_folder import BagFolder, Message, Ring, Topic, make_room
from anser_ros.wire.bag_writer import qos_profile
from anser_ros.wire.cdr import DEFINITIONS, string_bytes

TYPE = 'std_msgs/msg/String'
SECOND = 10**9


def topic(name, latched=False, type_name=TYPE):
    return Topic(name, type_name, DEFINITIONS[TYPE], [qos_profile(latched=latched)], '')


SETUP, POSE = topic('/anser/setup', latched=True), topic('/pose')


def message(of, stamp_s, text='x'):
    return Message(of, round(stamp_s * SECOND), string_bytes(text), None)


def seen(messages):
    return [(m.topic.name, m.log_time_ns / SECOND) for m in messages]


@pytest.mark.parametrize('limits', [{'max_duration_s': 2.0}, {'max_bytes': 3000}])
def test_each_file_of_a_split_bag_has_what_is_latched(tmp_path, limits):
    bag = BagFolder(tmp_path / 'bag', 'jazzy', **limits)
    for of in (SETUP, POSE):
        bag.add_topic(of)
    bag.write(message(SETUP, 0.0, 'schema'))
    for n in range(100):
        bag.write(message(POSE, 0.1 * n, f'{n}' * 20))
        bag.flush()
    bag.close()
    files = sorted((tmp_path / 'bag').glob('*.mcap'))
    assert len(files) >= 3
    info = yaml.safe_load((tmp_path / 'bag' / 'metadata.yaml').read_text())
    info = info['rosbag2_bagfile_information']
    assert info['relative_file_paths'] == [f'bag_{n}.mcap' for n in range(len(files))]
    poses = [m for m in iter_messages(tmp_path / 'bag', Salvage()) if m.topic == '/pose']
    assert [m.log_time_ns for m in poses] == [n * SECOND // 10 for n in range(100)]
    assert (
        info['message_count']
        == 100 + len(files)
        == sum(one['message_count'] for one in info['files'])
    )
    for file in files:
        first = next(iter_messages(file, Salvage()))
        assert (first.topic, first.data) == ('/anser/setup', string_bytes('schema'))


class TestRing:
    def test_holds_the_last_seconds_and_what_was_latched_before(self):
        ring = Ring(10.0, 10**6)
        ring.add(message(SETUP, 0.0, 'old'))
        ring.add(message(SETUP, 1.0, 'new'))
        for n in range(1, 31):
            ring.add(message(POSE, n))
        taken = ring.take(0)
        assert seen(taken) == [('/anser/setup', 21.0), *(('/pose', n) for n in range(21, 31))]
        assert taken[0].data == string_bytes('new')
        ring.add(message(POSE, 31))
        assert seen(ring.take(0)) == [('/anser/setup', 31.0), ('/pose', 31.0)], 'begun anew'

    def test_says_at_its_begin_what_was_in_force_then(self):
        ring = Ring(10.0, 10**6)
        for stamp_s, text in ((0.0, 'first'), (15.0, 'second')):
            ring.add(message(SETUP, stamp_s, text))
        ring.add(message(POSE, 20.0))
        assert [m.data for m in ring.latched(0)] == [string_bytes('second')]
        assert [m.data for m in ring.take(0)[:2]] == [
            string_bytes('first'),
            string_bytes('second'),
        ]

    def test_keeps_within_its_memory(self):
        ring = Ring(1e6, 1000)
        for n in range(100):
            ring.add(message(POSE, n, 'x' * 100))
            assert ring.bytes <= 1000
        assert 5 < len(ring.take(0)) < 10 and ring.bytes == 0

    def test_keeps_the_transforms_of_all_who_latch_one(self):
        ring = Ring(0.0, 1000)
        of = topic('/tf_static', latched=True, type_name='tf2_msgs/msg/TFMessage')
        for text in ('a', 'b', 'a'):
            ring.add(message(of, 1.0, text))
        assert [m.data for m in ring.take(0)] == [string_bytes('a'), string_bytes('b')]


def test_the_oldest_snapshots_make_room(tmp_path):
    for name in ('snapshot_20260101_000001', 'snapshot_20260101_000002', 'snapshot_x', 'scan'):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'a_0.mcap').write_bytes(b'x' * 1000)
    assert make_room(tmp_path, 2000) == []
    assert [folder.name for folder in make_room(tmp_path, 1500)] == ['snapshot_20260101_000001']
    assert len(list(tmp_path.iterdir())) == 3, 'only snapshots are removed'
