"""The watch over running trackers of poses: what a session has, and what changes, is said."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import diagnostics, spin_until
from geometry_msgs.msg import PoseStamped
from pose_world import World
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation

from anser_ros.apps.dashboard.nodes.watcher import Watcher
from anser_ros.apps.poses.live_look import PoseWatch, frozen_streams
from anser_ros.apps.poses.sequence import REFERENCE, PoseWindow
from anser_ros.errors import DiagnosisError, ParameterError
from anser_ros.nodes.runtime import qos

SECOND_NS = 1_000_000_000
LENGTH_S = 12.0


def rows_of(session):
    """Every pose of a session as (stamp_ns, stream, pose), in the order of the stamps."""
    rows = [
        (session.start_ns + round(t * 1e9), name, (*place, *turn))
        for name, poses in session.streams.items()
        for t, place, turn in zip(poses.time, poses.position, poses.quaternion, strict=True)
    ]
    return sorted(rows, key=lambda row: row[0])


def filled(session, *, start=0.0, end=1e9):
    window = PoseWindow(list(session.sensors), LENGTH_S)
    for stamp, name, pose in rows_of(session):
        if start < 1e-9 * (stamp - session.start_ns) < end:
            window.take(name, stamp, pose)
    return window.session()


def moved(session, change):
    """The reference's frame, or a sensor's mount, is another from the middle on."""
    name = REFERENCE if change == 'camera' else 'sensor_0'
    poses = session.streams[name]
    after = poses.time > 16.0
    place, turn = poses.position.copy(), Rotation.from_quat(poses.quaternion)
    if change == 'mount':
        place[after] += turn[after].apply([0.0, 0.008, 0.0])
        moved = replace(poses, position=place)
        return replace(session, sensors={**session.sensors, name: moved})
    pushed, quaternion = Rotation.from_euler('xyz', [3, -2, 5], degrees=True), turn.as_quat()
    place[after] = pushed.apply(place[after]) + [0.02, 0.0, -0.01]
    quaternion[after] = (pushed * turn[after]).as_quat()
    return replace(session, reference=replace(poses, position=place, quaternion=quaternion))


def test_the_window_keeps_so_many_seconds_and_begins_anew_when_time_runs_back():
    session = World(3, duration=20.0, sensors=1).session()
    window = PoseWindow(['sensor_0'], 5.0)
    for stamp, name, pose in rows_of(session):
        window.take(name, stamp, pose)
    seen = window.session()
    assert window.span_s == pytest.approx(5.0, abs=0.1)
    assert np.ptp(seen.reference.time) == pytest.approx(5.0, abs=0.1)
    assert window.session(without=[REFERENCE]).reference is None
    window.take('sensor_0', session.start_ns, (np.nan,) * 7)
    assert window.restarts == 1 and window.session().sensors['sensor_0'].missing.size == 1


def test_a_stream_that_stands_still_while_another_moves_is_frozen():
    session = World(3, duration=20.0, sensors=1).session()
    poses = session.sensors['sensor_0']
    place, turn = poses.position.copy(), poses.quaternion.copy()
    late = poses.time > 15.0
    place[late], turn[late] = place[late][0], turn[late][0]
    stuck = replace(session, sensors={'sensor_0': replace(poses, position=place, quaternion=turn)})
    (record,), since = frozen_streams(stuck)
    assert record.name == 'stale_poses' and record.parameters['stream'] == 'sensor_0'
    assert since == pytest.approx(15.0, abs=0.1)
    assert frozen_streams(session)[0] == ()
    seen = PoseWatch().look(filled(stuck, start=12.0))
    assert [r.name for r in seen.findings] == ['stale_poses'] and not seen.is_clear


@pytest.mark.long
@pytest.mark.parametrize(
    ('change', 'name', 'figure', 'size'),
    [('camera', 'registration', 'rotation_deg', 6.2), ('mount', 'loose_mount', 'rms_m', 8e-3)],
)
def test_what_changes_is_told_from_what_was_there(change, name, figure, size):
    session = moved(World(5, duration=32.0, sensors=2).session(), change)
    watch = PoseWatch()
    assert watch.look(filled(session, end=15.0)).is_clear
    seen = watch.look(filled(session, start=19.0))
    (found,) = seen.findings
    assert found.name == name
    assert np.linalg.norm(found.parameters[figure]) == pytest.approx(size, rel=0.05)
    # While the window spans the change nothing has a name, and something is said.
    between = watch.look(filled(session, start=13.0, end=17.5))
    assert not between.is_clear


def test_too_few_poses_are_refused():
    session = World(3, duration=20.0, sensors=1).session()
    with pytest.raises(DiagnosisError):
        PoseWatch().look(filled(session, end=1.2))


@pytest.mark.long
def test_over_dds_a_late_tracker_is_named_with_no_field_model(ros):
    world = World(7, duration=14.0, sensors=1)
    world.offset = 0.06
    topics = {'sensor_0': '/aurora/probe', REFERENCE: '/polaris/body'}
    given = {
        'tracked_poses': [topics['sensor_0']], 'reference_pose': topics[REFERENCE],
        'window_s': LENGTH_S, 'period_s': 0.2, 'cpu_share': 1.0,
    }  # fmt: skip
    node = Watcher(parameter_overrides=[Parameter(k, value=v) for k, v in given.items()])
    other = ros.create_node('trackers')
    lines = diagnostics(other)
    senders = {
        name: other.create_publisher(PoseStamped, topic, qos.STREAM)
        for name, topic in topics.items()
    }
    rows = rows_of(world.session())

    def spin(condition):
        def done():
            ros.spin_once(other, timeout_sec=0.0)
            return condition()

        return spin_until(node, done)

    try:
        assert spin(lambda: all(s.get_subscription_count() for s in senders.values()))
        for number, (stamp, name, (x, y, z, *turn)) in enumerate(rows):
            message = PoseStamped()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND_NS)
            p, q = message.pose.position, message.pose.orientation
            p.x, p.y, p.z, q.x, q.y, q.z, q.w = x, y, z, *turn
            senders[name].publish(message)
            if number % 4 == 3:
                spin(lambda last=number: node.counters['poses'] > last - 4)
        title = 'anser/watcher: time_offset'
        assert spin(lambda: title in lines), lines
        assert float(lines[title][2]['offset_s']) == pytest.approx(0.06, abs=3e-3)
        assert lines[title][0] == 1
        # What is silent is said by its topic.
        assert spin(lambda: 'no poses' in lines.get('anser/watcher', (0, ''))[1]), lines
    finally:
        node.close()
        node.destroy_node()
        other.destroy_node()


@pytest.mark.parametrize(
    'given', [{'tracked_poses': ['/a/pose']}, {'tracked_poses': ['/a/pose', '/tracked/a/pose']}]
)
def test_topics_that_make_no_session_are_refused(ros, given):
    with pytest.raises(ParameterError):
        Watcher(parameter_overrides=[Parameter(k, value=v) for k, v in given.items()])
