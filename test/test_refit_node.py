"""The refit inside its node: marker, centroid, health with names, services."""

import re
import time

import numpy as np
import pytest
from clouds_of import received
from geometry_msgs.msg import PoseStamped
from refit_rig import HEAD, STEP_NS, Rig, setup_text
from refit_world import metal_block
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker

from anser_ros.errors import FitError, FrameError, ModelFileError
from anser_ros.nodes.field_model_io import centroid_message, metal_markers, pose_in
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import Level
from anser_ros.nodes.tracker_models import ModelIntake
from anser_ros.pose_states import OTHER_MODEL, REFERENCES_LOST, code_of
from anser_ros.refit.model import Metal
from anser_ros.sessions.starting_model import load_model
from anser_ros.stamps import stamp_of
from anser_ros.wire.cdr import read_cloud

pytestmark = pytest.mark.usefixtures('shared_tables')


@pytest.fixture
def make(ros, tmp_path):
    rigs = []

    def build(**parameters):
        rigs.append(Rig(ros, tmp_path, **parameters))
        return rigs[-1]

    yield build
    for rig in rigs:
        rig.close()


def test_metal_is_shown_named_and_taken_away_again(make, tmp_path, capfd):
    rig = make(refit_rate_hz=1000.0, save_file=str(tmp_path / 'saved.yaml'))
    rig.start()
    said = capfd.readouterr()
    # Until there is one, the console says why poses will vanish, and what helps.
    assert 'call /anser/field_model/set_baseline, or give' in said.out + said.err
    change = rig.world.metal(HEAD)
    calibrated = rig.node._model
    for _ in range(4):
        rig.say(change, fault=3)
    rig.until(lambda: rig.markers and rig.centroids)
    point = rig.centroids[-1].point
    centre = HEAD.mean(axis=0)
    assert np.hypot(point.x - centre[0], point.y - centre[1]) < 0.06
    kinds = {m.type for m in rig.markers[-1].markers if m.action == Marker.ADD}
    assert kinds == {Marker.SPHERE_LIST, Marker.SPHERE}
    status = rig.node.status()
    assert status.values['refit_state'] == 'refit'
    assert status.values['references_left_out'] == 'ref/3'
    named = {part.name: part.message for part in rig.node.part_statuses()}
    assert named['ref/3'] == 'silent'
    assert named['ref/0'] == 'ok'
    assert rig.node._model is not calibrated
    # Frozen, the model stays; the metal goes, and then so does the marker.
    reply = rig.node._on_save(Trigger.Request(), Trigger.Response())
    assert 'snapshot of a refit' in reply.message
    with pytest.raises(ModelFileError, match='is not a calibration'):
        load_model(tmp_path / 'saved.yaml')
    rig.node._on_freeze(SetBool.Request(data=True), SetBool.Response())
    held = rig.node._model
    rig.say(0.0)
    assert rig.node._model is held
    rig.node._on_freeze(SetBool.Request(data=False), SetBool.Response())
    for _ in range(3):
        rig.say(0.0)
    np.testing.assert_array_equal(rig.node._model.moments, calibrated.moments)
    reply = rig.node._on_save(Trigger.Request(), Trigger.Response())
    assert reply.message == str(tmp_path / 'saved.yaml')
    load_model(tmp_path / 'saved.yaml')  # without metal it loads as ever
    rig.until(lambda: rig.markers[-1].markers[0].action == Marker.DELETEALL
              and len(rig.markers[-1].markers) == 1)  # fmt: skip
    for _ in range(2):
        rig.say(change)
    rig.node._on_reset(Trigger.Request(), Trigger.Response())
    np.testing.assert_array_equal(rig.node._model.moments, calibrated.moments)


def test_every_kind_of_bad_flux_has_its_counter_as_in_the_tracker(make):
    rig = make(refit_rate_hz=1000.0)
    rig.start()
    rig.say(0.0)
    node, channel = rig.node, rig.world.references.channel
    seen = node.counters.copy()
    clean = rig.world.baseline + rig.world.noise(rig.rng)
    state = node.status()
    assert (state.level, state.message) == (Level.OK, 'frozen')

    def send(flux=clean, flags=None, forward_ns=STEP_NS, **header):
        rig.stamp_ns += forward_ns
        message = rig.message(channel[: len(flux)], flux, flags)
        for name, value in header.items():
            whole = {'frame_id': message.header, 'nanosec': message.header.stamp, 'sec':
                     message.header.stamp}.get(name, message)  # fmt: skip
            setattr(whole, name, value)
        node._on_flux(received(message))

    before = node._stamp_ns
    send(frame_id='world')
    assert node.status().message.startswith("frozen; lately: fluxes in the frame 'world'")
    send(nanosec=1_000_000_000)
    send(sec=0, nanosec=0)
    send(clean[:, :7])
    assert 'lately: the model has 8 emitters, the fluxes 7' in node.status().message
    send(point_step=17)
    send(height=2)
    assert node._stamp_ns == before, 'nothing was answered'
    bad = clean.copy()
    bad[0, 0], bad[1, 1], bad[2, 2] = np.inf, 1e20, np.nan
    flags = np.zeros(len(clean), dtype=int)
    flags[3:7] = 1, 2, 4, 5
    send(bad, flags)
    named = {part.name: part.message for part in node.part_statuses()}
    assert [named[f'ref/{i}'] for i in range(4)] == [
        'not finite', 'absurd', 'not finite', 'flagged',
    ]  # fmt: skip
    assert node._refit.result.state == 'frozen'
    send(clean[:-2])
    send(clean[:0])
    send(forward_ns=0)
    dead = clean.copy()
    dead[:, 6] = 0.0
    send(dead)
    state = node.status()
    assert (state.level, state.message) == (Level.WARN, 'no flux of coil6')
    send(forward_ns=3 * 10**9)
    send(forward_ns=-(10**9))
    send(is_bigendian=True)
    new = node.counters - seen
    total = len(clean)
    missing, absurd = new.pop('readings_missing'), new.pop('readings_absurd')
    # The bytes that were called big endian make other channels and absurd numbers.
    assert missing - 2 - total in range(total + 1) and absurd >= 1
    for other in ('refits', 'readings_not_finite'):
        assert new.pop(other) > 0
    new.pop('models', 0)
    assert new == {
        'fluxes_other_frame_id': 1, 'fluxes_without_stamp': 2, 'fluxes_refused': 6,
        'frames': 7, 'frames_empty': 1, 'duplicates': 1, 'time_jumps': 1, 'time_jumps_forward': 1,
        'readings_saturated': 2, 'readings_stale': 1, 'readings_dropped': 1,
        'frames_dead_emitter': 1, 'fluxes_big_endian': 1,
    }  # fmt: skip
    node._trouble.say('an old one', time.monotonic() - 11.0)
    state = node.status()
    assert 'lately' not in state.message and state.values['last_refusal'] == 'an old one'


def test_an_absurd_reading_is_no_baseline(make):
    rig = make()
    rig.node._on_setup(String(data=setup_text(rig.world)))
    for _ in range(12):
        rig.say(np.where(np.arange(len(rig.world.baseline))[:, None] == 2, 1e15, 0.0))
    assert rig.node.counters['readings_absurd'] == 12
    reply = rig.node._on_set_baseline(Trigger.Request(), Trigger.Response())
    count = len(rig.world.baseline)
    assert reply.message.startswith(f'baseline of {count - 1} references')


def test_a_baseline_of_too_few_is_refused_and_the_old_one_holds(make):
    rig = make()
    rig.start()
    refit = rig.node._refit.current
    few = np.where(np.arange(len(rig.world.baseline))[:, None] < 3, 0.0, np.nan)
    for _ in range(20):
        rig.say(few)
    state = rig.node.status()
    assert state.level == Level.WARN and state.message.startswith('few_references: 3 usable')
    said = 'a new baseline was refused: '
    assert said not in state.message
    with pytest.raises(FitError, match='3 of 16 reference sensors; 4 are needed'):
        rig.node._on_set_baseline(Trigger.Request(), Trigger.Response())
    assert rig.node._refit.current is refit
    state = rig.node.status()
    assert state.level == Level.WARN and said + 'a baseline of 3 of 16' in state.message
    for _ in range(20):
        rig.say(0.0)
    assert said in rig.node.status().message, 'until there is one'
    assert rig.node._on_set_baseline(Trigger.Request(), Trigger.Response()).success
    assert said not in rig.node.status().message


def test_metal_at_rest_is_in_no_baseline(make):
    rig = make(baseline_at_start=True)
    metal = rig.world.metal(metal_block((0.03, 0.0, -0.06), (0.15, 0.15, 0.004)))
    rig.node._on_setup(String(data=setup_text(rig.world)))
    for _ in range(12):
        rig.say(metal)
    assert rig.node.counters['baselines_refused'] == 1
    state = rig.node.status()
    assert state.level == Level.WARN and 'constant, no baseline: ' in state.message
    for _ in range(4):
        rig.say(metal)
    with pytest.raises(FitError, match='drawn board'):
        rig.node._on_set_baseline(Trigger.Request(), Trigger.Response())
    for _ in range(24):
        rig.say(0.0)
    rig.until(lambda: rig.node._refit.current is not None)
    assert 'no baseline' not in rig.node.status().message


def test_a_model_beside_its_board_gives_no_poses_until_the_references_agree(make):
    rig = make(baseline_at_start=True)
    table = rig.world.references
    there = table.position - [0.002, 0.0, 0.0]
    aside = rig.world.model.flux(there, table.axis, table.length)
    here = rig.world.model.flux(table.position, table.axis, table.length)
    rig.node._on_setup(String(data=setup_text(rig.world)))
    assert rig.node.status().message == f'{REFERENCES_LOST}: no reference fluxes yet'
    assert rig.codes == [], 'the model was withheld from the beginning'
    rig.say(aside - here)
    state = rig.node.status()
    assert state.level == Level.ERROR
    assert re.match(r'other_model: the model lies (1\.9|2\.0|2\.1) mm', state.message)
    assert rig.codes[-1] == code_of(OTHER_MODEL)
    for _ in range(12):
        rig.say(aside - here)
    assert rig.codes[-1] == code_of(OTHER_MODEL) and not rig.node._refit.is_making
    for _ in range(24):
        rig.say(0.0)
    rig.until(lambda: rig.node._refit.current is not None)
    assert rig.codes[-1] == 0
    assert rig.node.status().level == Level.OK


def test_every_frame_is_answered_under_its_own_stamp(make):
    rig, got = make(refit_rate_hz=10.0), []
    rig.peer.create_subscription(PointCloud2, 'field_model', got.append, qos.LATCHED)
    rig.until(lambda: rig.node._output.models.get_subscription_count() > 0)
    rig.start()
    answered, models = [], rig.node.counters['models']
    for _ in range(12):
        rig.say(0.0)
        answered.append(rig.stamp_ns)
        rig.until(lambda: got and stamp_of(got[-1]) == rig.stamp_ns)
    assert rig.node.counters['frames_between_refits'] > 0
    assert rig.node.counters['models'] == models, 'nothing changed, so it is the same model'
    rig.say(rig.world.metal(HEAD))
    rig.until(lambda: stamp_of(got[-1]) == rig.stamp_ns)
    assert [stamp_of(m) for m in got[-13:-1]] == answered


def pose_message(position, frame='fg'):
    message = PoseStamped()
    message.header.frame_id = frame
    p = message.pose.position
    p.x, p.y, p.z = (float(v) for v in position)
    message.pose.orientation.w = 1.0
    return message


def test_a_pose_in_another_frame_or_of_nothing_is_refused(ros):

    with pytest.raises(FrameError, match="in 'camera', not 'fg'"):
        pose_in(pose_message([0, 0, 0], 'camera'), 'fg', 'tool')
    with pytest.raises(FrameError, match='is not finite'):
        pose_in(pose_message([np.nan, 0, 0]), 'fg', 'tool')


def test_markers_of_nothing_and_of_one_source(ros):
    assert [m.action for m in metal_markers(None, 'fg', 5).markers] == [Marker.DELETEALL]
    metal = Metal(np.ones((1, 3)), np.array([-3.0 + 0j]), np.array([1e-6]), np.ones(3))
    markers = metal_markers(metal, 'fg', 7_000_000_001).markers
    assert [m.type for m in markers[1:]] == [Marker.SPHERE_LIST, Marker.SPHERE]
    assert markers[1].scale.x == pytest.approx(0.008)
    assert centroid_message(metal, 'fg', 7_000_000_001).header.stamp.nanosec == 1


def test_lost_references_are_told_to_the_trackers_and_to_the_operator(make):
    rig, intake, given = make(refit_rate_hz=1000.0), ModelIntake(), []
    rig.node._on_setup(String(data=setup_text(rig.world, references_age_s=2.0)))
    rig.node._output.errors.publish = lambda message: intake.take_error(read_cloud(message))
    rig.node._output.models.publish = lambda message: given.append(
        intake.take(read_cloud(message))
    )
    rig.start()
    change = rig.world.metal(HEAD)
    for _ in range(3):
        rig.say(change)
    assert given[-1].follows and given[-1].withheld == ''
    near = given[-1]
    gone = np.where(np.arange(len(change))[:, None] < 3, change, np.nan)
    rig.say(gone)
    assert rig.node.status().message.startswith('few_references: 3 usable')
    assert given[-1].withheld == 'references_lost'
    np.testing.assert_array_equal(given[-1].points.moments, near.points.moments)
    rig.say(change)
    assert given[-1].withheld == ''
    rig.until(lambda: rig.node.status().level == Level.ERROR)
    assert rig.node.status().message.startswith('references_lost: no reference fluxes for ')
