"""Two boards on one graph share no topic and no frame, and what one records is its own."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.parameter import Parameter
from tracking_world import flux_points

from anser_ros.apps.dashboard.nodes.monitor import Monitor
from anser_ros.errors import LayoutError
from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.pose_output import PoseTopic
from anser_ros.nodes.recorder import Recorder
from anser_ros.nodes.replay import Replay
from anser_ros.nodes.streams.clouds import read_frame
from anser_ros.wire.bag import read_bag
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.cdr import CloudHeader, PointCloud, Stamp
from anser_ros.wire.points import encode_flux
from anser_ros.wire.recorded import optical_topic

BAG = Path(__file__).resolve().parents[1] / 'bags' / 'moving.mcap'
SHARED = {'/diagnostics', '/rosout', '/parameter_events'}


def node_of(kind, board, *arguments, **values):
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    return kind(*arguments, namespace=board, parameter_overrides=overrides)


def names(pairs):
    return {name for name, _ in pairs} - SHARED


def test_two_replays_share_no_topic(ros):
    made = {
        board: node_of(
            Replay, board, str(BAG), optical=f'/{board}/optical', clock=f'/{board}/clock'
        )
        for board in ('left', 'right')
    }
    try:
        topics = {
            board: names(node.get_publisher_names_and_types_by_node('replay', f'/{board}'))
            for board, node in made.items()
        }
        assert {'/left/tool/flux', '/left/optical/tool_a/pose', '/left/clock'} <= topics['left']
        assert not topics['left'] & topics['right']
    finally:
        for node in made.values():
            node.close()
            node.destroy_node()


def test_a_recorder_and_a_monitor_take_what_is_their_boards(ros, tmp_path):
    text = read_bag(BAG).setup_text
    recorder = node_of(
        Recorder, 'left', optical='/left/optical', directory=str(tmp_path), autostart=False
    )
    monitor = node_of(Monitor, 'left', optical='/left/optical')
    try:
        wanted = ('/left/tool/flux', '/left/optical/tool_a/pose', '/diagnostics')
        assert all(recorder._wanted(topic) for topic in wanted)
        unwanted = ('/right/tool/flux', '/right/optical/tool_a/pose', '/optical/tool_a/pose')
        assert not any(recorder._wanted(topic) for topic in unwanted)
        monitor._on_setup(SimpleNamespace(data=text))
        heard = names(monitor.get_subscriber_names_and_types_by_node('monitor', '/left'))
        assert '/left/optical/tool_a/pose' in heard and '/optical/tool_a/pose' not in heard
    finally:
        for node in (recorder, monitor):
            node.close()
            node.destroy_node()


def test_clouds_and_metal_have_their_boards_prefix(ros):
    """And whoever reads them takes a board's frame with any prefix."""
    node = node_of(FieldModelNode, 'left', frame_prefix='left_')
    try:
        assert (node._shown_frame, node._frame_id) == ('left_fg', 'fg')
    finally:
        node.destroy_node()
    for frame, said in (('left_fg', 'no stamp'), ('base', "frame 'base'"), ('wfg', "'wfg'")):
        cloud = PointCloud(CloudHeader(Stamp(0, 0), frame), 1, 0, [], False, 0, memoryview(b''))
        with pytest.raises(LayoutError, match=said):
            read_frame(cloud, 'fg', lambda *_: None)


def test_frames_have_their_boards_prefix(ros):
    node = ros.create_node('peer')
    try:
        first, second = (
            PoseTopic(node, 'tool_a/0/x', 'fg', f'{board}_')._transform
            for board in ('left', 'right')
        )
        assert (first.header.frame_id, first.child_frame_id) == ('left_fg', 'left_tool_a_0/x')
        assert second.child_frame_id == 'right_tool_a_0/x'
        assert PoseTopic(node, 'tool_a', 'fg')._transform.child_frame_id == 'tool_a'
    finally:
        node.destroy_node()


@pytest.mark.parametrize('optical', ['/optical', '/left/optical'])
def test_a_bag_has_its_optical_poses_whatever_their_namespace(tmp_path, optical):
    bag = read_bag(BAG)
    count = bag.tool.channel.size
    with SessionWriter(tmp_path / 'left.mcap') as writer:
        stamp = int(bag.tool.stamp_ns[0])
        writer.write_setup(bag.setup_text, stamp)
        points = flux_points(bag.tool.flux[0], channels=bag.tool.channel)
        fields, step, data = encode_flux(points)
        writer.write_flux('/left/tool/flux', stamp, fields, step, count, data)
        track = bag.optical['tool_a']
        writer.write_pose(
            optical_topic('tool_a', optical), stamp, track.position[0], track.quaternion[0]
        )
    again = read_bag(tmp_path / 'left.mcap')
    np.testing.assert_allclose(again.optical['tool_a'].position[0], track.position[0])
    assert not again.refused
