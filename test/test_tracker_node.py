"""The node tracker over DDS: poses, states, parameters, and a recorded session."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from graph_bench import BODY, SENSORS, Bench, ready, reference_specs, tracker_bench, wait_frame
from rclpy.parameter import Parameter
from tracking_world import certain_model, fluxes, random_pose, setup_of

from anser_ros.errors import ParameterError
from anser_ros.field.model import EffectRecord
from anser_ros.nodes import pose_output
from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.tracker import TrackerNode
from anser_ros.physics.rotations import rotation_of_quaternion
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import save_model
from anser_ros.wire.setup import dump_setup
from anser_ros.wire.setup_values import TipSpec

tracker = pytest.fixture(tracker_bench)


def axis_of(pose):
    q = pose.orientation
    return rotation_of_quaternion(np.array([q.x, q.y, q.z, q.w]))[:, 2]


def place_of(pose):
    return np.array([pose.position.x, pose.position.y, pose.position.z])


def test_poses_of_every_sensor_and_body(tracker):
    rng = np.random.default_rng(1)
    ready(tracker)
    position, rotation = random_pose(rng)
    message = tracker.say_flux(fluxes(certain_model(), SENSORS, position, rotation, rng))
    names = {*SENSORS.name, BODY}
    tracker.spin_until(lambda: tracker.poses.keys() == tracker.full.keys() == names)
    points, axes = SENSORS.placed(position, rotation)
    for i, name in enumerate(SENSORS.name):
        pose = tracker.poses[name][0]
        assert pose.header.stamp == message.header.stamp
        assert pose.header.frame_id == 'fg'
        assert np.linalg.norm(place_of(pose.pose) - points[i]) < 1e-3
        assert np.linalg.norm(axis_of(pose.pose) - axes[i]) < 0.02
        covariance = tracker.full[name][0].pose.covariance.reshape(6, 6)
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
        roll = axes[i] @ covariance[3:, 3:] @ axes[i]
        assert roll > 3.0, 'roll is not observable, and the covariance says so'
        assert np.trace(covariance[3:, 3:]) - roll < 1e-3
    body = tracker.poses[BODY][0].pose
    turn = body.orientation
    found = rotation_of_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
    assert np.linalg.norm(place_of(body) - position) < 3e-4
    np.testing.assert_allclose(found, rotation, atol=5e-3)


def test_nothing_is_published_unless_ok(tracker):
    rng = np.random.default_rng(2)
    ready(tracker)
    flux = fluxes(certain_model(), SENSORS, *random_pose(rng), rng)
    flux[0] = np.nan
    flux[1] = np.inf
    flux[2] = 0.0
    flux[3, 4] *= 1.3
    tracker.say_flux(flux, flags=np.array([0, 0, 0, 0, 1, 2, 4, 0, 0]))
    good = {*SENSORS.name[7:], BODY}
    tracker.spin_until(lambda: good <= tracker.poses.keys())
    tracker.node.publish_diagnostics()
    # Words from before the frame may still be on their way.
    tracker.spin_until(lambda: tracker.state(f'anser/tracker: {BODY}') == 'ok')
    states = [tracker.states[f'anser/tracker: {name}'][0] for name in SENSORS.name]
    assert states == [
        'no_signal', 'no_signal', 'no_signal', 'residual', 'saturated', 'stale', 'dropped', 'ok',
        'ok',
    ]  # fmt: skip
    assert tracker.poses.keys() == good
    assert tracker.states[f'anser/tracker: {SENSORS.name[0]}'][1]['reason']
    assert tracker.states[f'anser/tracker: {BODY}'][0] == 'ok'


def test_states_without_model_setup_or_data(tracker):
    rng = np.random.default_rng(3)
    flux = fluxes(certain_model(), SENSORS, *random_pose(rng), rng)
    tracker.say_flux(flux)
    tracker.spin_until(lambda: tracker.node.counters['fluxes_before_setup'] == 1)
    tracker.say_setup()
    tracker.spin_until(lambda: tracker.node._half is not None)
    tracker.say_flux(flux)
    wait_frame(tracker, 1)
    tracker.node.publish_diagnostics()
    tracker.spin_until(lambda: tracker.state('anser/tracker: tool_a') == 'no_model')
    assert tracker.state('anser/tracker') == 'no field model yet'
    tracker.node.set_parameters([Parameter('stale_after_s', value=0.3)])

    def is_stale():
        tracker.node.publish_diagnostics()
        return tracker.state('anser/tracker: tool_a') == 'stale'

    tracker.spin_until(is_stale)


def test_another_model_while_it_runs(tracker, tmp_path):
    """The effects of a model that is loaded are undone, and with the one of before no longer."""

    def give(name):
        return tracker.node.set_parameters([Parameter('model_file', value=name)])[0]

    def place(gain=1.0):
        tracker.poses.clear()
        flux = fluxes(certain_model(), SENSORS, position, rotation, rng)
        tracker.say_flux(np.vstack([gain * flux[:1], flux[1:]]))
        tracker.spin_until(lambda: BODY in tracker.poses)
        return SENSORS.name[0] in tracker.poses

    rng = np.random.default_rng(5)
    position, rotation = random_pose(rng)
    record = EffectRecord(
        'sensor_gain', {'channel': int(SENSORS.channel[0]), 'gain': 1.2, 'phase_deg': 0.0}
    )
    with_gain = replace(certain_model(), effects=(record,))
    save_model(tmp_path / 'gain.yaml', with_gain)
    ready(tracker)
    assert place()
    assert give(str(tmp_path / 'gain.yaml')).successful
    assert tracker.node.status().values['corrected'] == 'sensor_gain (channel 0)'
    assert place(1.2), 'with a fifth more of signal it is where it was'
    assert give('').successful
    assert not tracker.node.status().values['corrected']
    refused = give(str(tmp_path / 'nowhere.yaml'))
    assert not refused.successful
    assert tracker.node.parameters.model_file == ''
    assert tracker.node.counters['callback_faults'] == 0


@pytest.mark.parametrize('none', ['', 'nominal'])
def test_without_its_model_file_no_pose_is_given_by_the_old_field(tracker, tmp_path, none):
    """No server has published a model, so that the file's field was what frames were solved by."""
    save_model(tmp_path / 'own.yaml', certain_model())
    give = (
        [Parameter('model_file', value=str(tmp_path / 'own.yaml'))],
        [Parameter('model_file', value=none)],
    )
    rng = np.random.default_rng(5)
    tracker.say_setup()
    tracker.spin_until(lambda: tracker.node._half is not None)
    for parameters, state in zip(give, ('ok', 'no_model'), strict=True):
        assert tracker.node.set_parameters(parameters)[0].successful
        tracker.say_flux(fluxes(certain_model(), SENSORS, *random_pose(rng), rng))

        def is_so(state=state):
            tracker.node.publish_diagnostics()
            return tracker.state(f'anser/tracker: {BODY}') == state

        tracker.spin_until(is_so)


def test_the_gate_may_change_while_it_runs(tracker):
    ready(tracker)
    results = tracker.node.set_parameters([Parameter('gate', value=7.5)])
    assert results[0].successful
    assert tracker.node._half.tracker.settings.gate == 7.5
    assert tracker.node.status().level == 0
    tracker.node.set_parameters([Parameter('gate', value=1e6)])
    assert tracker.node.status().level == 1 and 'gate of 1e+06' in tracker.node.status().message
    assert not tracker.node.set_parameters([Parameter('gate', value=-1.0)])[0].successful
    assert not tracker.node.set_parameters([Parameter('publish_tf', value=False)])[0].successful


def test_transforms_where_they_are_installed(tracker, monkeypatch):
    """Stands in for tf2_msgs, which the wheels don't have."""
    sent = []
    monkeypatch.setattr(pose_output, 'TFMessage', lambda transforms: list(transforms))
    publisher = SimpleNamespace(publish=sent.append, get_subscription_count=lambda: 1)
    tracker.node._transforms = publisher
    rng = np.random.default_rng(7)
    ready(tracker)
    position, rotation = random_pose(rng)
    tracker.say_flux(fluxes(certain_model(), SENSORS, position, rotation, rng))
    tracker.spin_until(lambda: bool(sent))
    frames = {t.child_frame_id: t for t in sent[0]}
    assert frames.keys() == {'tool_a', *(n.replace('tool_a/', 'tool_a_') for n in SENSORS.name)}
    move = frames['tool_a'].transform.translation
    assert np.linalg.norm(np.array([move.x, move.y, move.z]) - position) < 3e-4
    assert frames['tool_a'].header.frame_id == 'fg'


def test_where_the_board_is_is_stated(ros, tmp_path, monkeypatch):
    """By parameters, by a registration, and anew where they change; what is no pose is refused."""
    sent, names = [], []
    monkeypatch.setattr(pose_output, 'TFMessage', lambda transforms: transforms[0])
    publisher = SimpleNamespace(publish=sent.append, get_subscription_count=lambda: 0)
    plain = TrackerNode.create_publisher

    def create(self, kind, topic, profile, **options):
        names.append((topic, profile.durability.name))
        return publisher if topic.startswith('/tf') else plain(self, kind, topic, profile)

    def given(**values):
        return [Parameter(name, value=value) for name, value in values.items()]

    monkeypatch.setattr(TrackerNode, 'create_publisher', create)
    pose = [0.4, 0.0, 0.1, 0.0, 0.0, 0.6, 0.8]
    node = TrackerNode(
        parameter_overrides=given(parent_frame='base', board_pose=pose, frame_prefix='left_')
    )
    try:
        assert ('/tf_static', 'TRANSIENT_LOCAL') in names
        assert (sent[0].header.frame_id, sent[0].child_frame_id) == ('base', 'left_fg')
        turn = sent[0].transform.rotation
        assert (sent[0].transform.translation.x, turn.z, turn.w) == (0.4, 0.6, 0.8)
        file = tmp_path / 'handeye.json'
        found = {
            'registration_quaternion_xyzw': [0.0, 0.0, 0.6, 0.8],
            'registration_translation_m': [1.0, 0.0, 0.0],
        }
        file.write_text(json.dumps(found))
        assert node.set_parameters(given(registration_file=str(file)))[0].successful
        place, turn = sent[-1].transform.translation, sent[-1].transform.rotation
        assert (place.x, place.y, turn.z) == pytest.approx((-0.28, 0.96, -0.6))
        for wrong in (tmp_path / 'none.json', 5):
            text = str(wrong) if wrong != 5 else ''
            refused = node.set_parameters(given(registration_file=text, board_pose=[1.0]))
            assert not all(one.successful for one in refused)
    finally:
        node.destroy_node()
    with pytest.raises(ParameterError, match='board_pose: x y z'):
        TrackerNode(parameter_overrides=given(parent_frame='base'))


def test_no_pose_is_given_outside_the_volume_of_the_setup(tracker):
    rng, node = np.random.default_rng(8), tracker.node
    box = ((-0.1, -0.1, 0.2), (0.1, 0.1, 0.3))
    tracker.say_setup(dump_setup(replace(setup_of(SENSORS, reference_specs()), volume=box)))
    tracker.say_model(certain_model())
    tracker.spin_until(lambda: node.counters['models'] >= 1)
    tracker.say_flux(fluxes(certain_model(), SENSORS, np.array([0.0, 0.0, 0.15]), np.eye(3), rng))
    wait_frame(tracker, 1)
    node.publish_diagnostics()
    tracker.spin_until(lambda: tracker.state('anser/tracker: tool_a') == 'outside_volume')


def test_what_acquisition_measures_meanwhile_changes_settings_only(tracker):
    """Rate, noise and stamps: topics that were made again would be discovered again first."""
    rng, node = np.random.default_rng(11), tracker.node

    def say_flux():
        pose = np.array([0.0, 0.0, 0.15]), np.eye(3)
        tracker.say_flux(fluxes(certain_model(), SENSORS, *pose, rng))

    ready(tracker)
    say_flux()
    wait_frame(tracker, 1)
    topics, context = dict(node._topics), node._half.tracker._scene.context
    noise = node._half.tracker.settings.flux_noise_t
    plain = setup_of(SENSORS, reference_specs())

    def measured(**values):
        text = dump_setup(replace(plain, flux_rate_hz=49.0, extra=values))
        tracker.say_setup(text)
        tracker.spin_until(lambda: node._setup_text == text)
        say_flux()

    measured(stamp_sigma_s=3e-4)
    wait_frame(tracker, 2)
    assert node._half.tracker.settings.stamp_sigma_s == 3e-4
    assert node._half.tracker._scene.context is context, 'which takes a tenth of a second to make'
    assert node._half.tracker.counters['cold_starts'] == len(SENSORS.name)
    measured(stamp_sigma_s=3e-4, flux_noise_t=2.0 * noise)
    wait_frame(tracker, 3)
    assert node._half.tracker.settings.flux_noise_t == 2.0 * noise
    assert np.all(node._half.tracker._scene.context.sigma > context.sigma)
    assert node._topics == topics
    assert {topic.estimate.state for topic in topics.values()} == {'ok'}

    tracker.say_setup(dump_setup(setup_of(SENSORS.select(np.arange(3)), reference_specs())))
    tracker.spin_until(lambda: len(node._topics) < len(topics))


def test_the_nominal_model_is_no_file(ros):
    node = TrackerNode(parameter_overrides=[Parameter('model_file', value='nominal')])
    assert node.status().message == 'no setup yet'
    node.destroy_node()


def test_both_nodes_track_a_recorded_session(ros, shared):
    """The chain of field_model and tracker on a recording that this package did not make."""
    session = load_session(shared / 'sessions' / 'effects' / 's01.mcap')
    tool = session.tools[0]
    allowed = [Parameter('allow_uncalibrated', value=True)]
    server, node = FieldModelNode(parameter_overrides=allowed), TrackerNode()
    bench = Bench(ros, node)
    bench.executor.add_node(server)
    try:
        bench.connect(bench.setup, bench.flux)
        bench.say_setup(dump_setup(session.setup))
        bench.spin_until(
            lambda: node.counters['models'] >= 1 and node._half.tracker.model.modes is not None
        )
        bench.spin_until(
            lambda: all(t._pose.get_subscription_count() for t in node._topics.values())
        )
        for frame in range(0, 60, 2):
            bench.say_flux(tool.flux[frame], stamp_ns=session.start_ns + round(4e7 * frame) + 1)
        bench.spin_until(lambda: len(bench.full.get(BODY, [])) >= 30)
    finally:
        bench.close()
        server.destroy_node()
    for frame, message in zip(range(0, 60, 2), bench.full[BODY], strict=True):
        away = np.linalg.norm(place_of(message.pose.pose) - tool.position[frame])
        sigma = np.sqrt(np.trace(message.pose.covariance.reshape(6, 6)[:3, :3]))
        assert away < 4e-3, 'a drawn board is good to a few millimetres'
        assert away < 4.0 * np.hypot(sigma, 0.12e-3), 'and it knows'


def test_the_tip_of_a_body_has_its_own_topics(tracker):
    spec = TipSpec((0.01, 0.02, -0.15), (1e-8, 0.0, 0.0, 1e-8, 0.0, 4e-8))
    for kind, ending, box in (
        (PoseStamped, 'pose', tracker.poses),
        (PoseWithCovarianceStamped, 'pose_with_covariance', tracker.full),
    ):
        tracker.peer.create_subscription(
            kind, f'{BODY}/tip/{ending}', tracker._keep(box, 'tip'), 10
        )
    rng = np.random.default_rng(1)
    setup = setup_of(SENSORS, reference_specs()).with_tips({BODY: spec})
    tracker.say_setup(dump_setup(setup))
    tracker.say_model(certain_model())
    tracker.spin_until(lambda: tracker.node.counters['models'] >= 1)
    tracker.spin_until(lambda: tracker.node._topics[f'{BODY}/tip'].listeners == 2)
    tracker.spin_until(lambda: tracker.node._topics[BODY].listeners == 2)
    position, rotation = random_pose(rng)
    message = tracker.say_flux(fluxes(certain_model(), SENSORS, position, rotation, rng))
    tracker.spin_until(
        lambda: {'tip', BODY} <= tracker.poses.keys() and {'tip', BODY} <= tracker.full.keys()
    )
    pose = tracker.poses['tip'][0]
    assert pose.header.stamp == message.header.stamp and pose.header.frame_id == 'fg'
    assert np.linalg.norm(place_of(pose.pose) - position - rotation @ spec.position_m) < 1.5e-3
    assert pose.pose.orientation == tracker.poses[BODY][0].pose.orientation
    tip, body = (tracker.full[n][0].pose.covariance.reshape(6, 6) for n in ('tip', BODY))
    assert np.trace(tip[:3, :3]) > np.trace(body[:3, :3]) + np.trace(spec.covariance)
    np.testing.assert_array_equal(tip[3:, 3:], body[3:, 3:])
