"""What the node hands to the refit: readings and poses of the same frame, once."""

from functools import partial

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from tracked_tool import CHANNELS, MODEL, TOOL

from anser_ros.nodes.field_model_io import ToolWitnesses
from anser_ros.nodes.runtime.handover import HandedFlux
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.wire.points import FluxPoints
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config


class Refit:
    """Stands for the refit: notes what it is given."""

    def __init__(self):
        self.given = []

    def witnessed(self, readings):
        self.given.append(readings)


@pytest.fixture
def witnesses(ros):
    class Server(AnserNode):
        NAME = 'server'

    node, refused = Server(), []
    made = ToolWitnesses(node, True, lambda: 'fg', lambda *why: refused.append(why))
    made.expect(parse_setup(read_config('demo_setup.yaml')), MODEL)
    made.refused = refused
    yield made
    node.destroy_node()


def flux(stamp_ns, level):
    """A frame of all of the tool's channels, each emitter with the same flux."""
    values = np.full((len(CHANNELS), 8), level, dtype=np.complex128)
    values[2] = np.nan
    flags, nowhere = np.zeros(len(CHANNELS), np.int64), np.full((len(CHANNELS), 3), np.nan)
    points = FluxPoints(np.asarray(CHANNELS), flags, values, nowhere, nowhere)
    return HandedFlux(stamp_ns, 'fg', points)


def pose(stamp_ns, x, frame_id='fg'):
    message = PoseStamped()
    message.header.frame_id, message.header.stamp.nanosec = frame_id, stamp_ns
    message.pose.position.x, message.pose.orientation.w = x, 1.0
    return message


def test_readings_and_poses_of_one_frame_come_together_in_any_order(witnesses):
    refit, found = Refit(), partial(witnesses._on_pose, 'tool_a')
    assert witnesses.noise_t > 0
    witnesses._on_flux(flux(100, 1e-9))
    found(pose(100, 0.01))
    found(pose(200, 0.02))  # the next frame is here before the references of this one
    witnesses._on_flux(flux(200, 2e-9))
    for stamp_ns in (100, 100, 200, 300):
        witnesses.pass_on(refit, stamp_ns)
    assert len(refit.given) == 2, 'no frame twice, none without readings'
    for (reading,), x, level in zip(refit.given, (0.01, 0.02), (1e-9, 2e-9), strict=True):
        assert reading.position[0] == x and np.array_equal(reading.rotation, np.eye(3))
        assert (reading.flux == level).all()
        assert len(reading.table) == len(TOOL) - 1, 'the one without a reading is left out'


def test_what_has_no_partner_is_forgotten_and_an_earlier_recording_is_taken(witnesses):
    refit, found = Refit(), partial(witnesses._on_pose, 'tool_a')
    for stamp_ns in range(1000, 3000, 100):
        found(pose(stamp_ns, 0.01))
        witnesses._on_flux(flux(stamp_ns + 1, 1e-9))
    assert len(witnesses._frames) < 10 and len(witnesses._poses) < 10
    found(pose(5, 0.03))
    witnesses._on_flux(flux(5, 3e-9))
    witnesses.pass_on(refit, 5)
    assert refit.given[0][0].position[0] == 0.03


def test_poses_of_another_frame_are_refused(witnesses):
    refit = Refit()
    witnesses._on_flux(flux(100, 1e-9))
    witnesses._on_pose('tool_a', pose(100, 0.01, 'world'))
    witnesses.pass_on(refit, 100)
    assert not refit.given
    ((counter, error),) = witnesses.refused
    assert counter == 'tool_poses_refused' and "'world'" in str(error)


def test_a_body_whose_poses_have_two_publishers_witnesses_nothing(ros, witnesses):
    from conftest import spin_until

    stranger, refit = ros.create_node('stranger'), Refit()
    publishers = [stranger.create_publisher(PoseStamped, '/anser/tool_a/pose', 5) for _ in 'ab']
    assert spin_until(stranger, lambda: stranger.count_publishers('/anser/tool_a/pose') == 2)
    witnesses._on_flux(flux(100, 1e-9))
    witnesses._on_pose('tool_a', pose(100, 0.01))
    assert spin_until(stranger, lambda: not witnesses._has_one_source('tool_a'))
    witnesses.pass_on(refit, 100)
    assert not refit.given
    for publisher in publishers:
        stranger.destroy_publisher(publisher)
    stranger.destroy_node()
