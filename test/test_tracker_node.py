"""The nodes tracker and field_model over DDS: poses, states, and what they refuse."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from tracking_world import certain_model, fluxes, random_pose, setup_of, triaxial_tool

from anser_ros.errors import ParameterError
from anser_ros.physics.volume import TrackedVolume
from anser_ros.sessions.model_file import load_model, save_model
from anser_ros.sessions.tracker_settings import settings_for
from anser_ros.tracking.rotations import rotation_of_quaternion
from anser_ros.tracking.tracker import Tracker
from anser_ros.wire.points import DipolePoints, FluxPoints, encode_field_model
from anser_ros.wire.setup import SensorSpec, dump_setup

SENSORS = triaxial_tool()
BODY = 'tool_a'
FIRST_NS = 1_750_000_000_000_000_000


def reference_specs(count=8):
    """Coils around the volume, two at each place."""
    rng = np.random.default_rng(5)
    specs = []
    for i in range(count):
        angle = 2 * np.pi * (i // 2) / (count // 2)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        place = (0.16 * np.cos(angle), 0.16 * np.sin(angle), 0.05)
        specs.append(
            SensorSpec(16 + i, f'ref/{i}', 'fg', tuple(map(float, place)), tuple(map(float, axis)),
                       0.0)
        )  # fmt: skip
    return tuple(specs)


class Bench:
    """The test's own end of the graph."""

    def __init__(self, ros, node):
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import String

        from anser_ros.nodes import qos
        from anser_ros.nodes.clouds import FluxCloud

        self.peer = ros.create_node('bench', namespace='anser')
        self.node = node
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(node)
        self.executor.add_node(self.peer)
        self.setup = self.peer.create_publisher(String, 'setup', qos.LATCHED)
        self.flux = self.peer.create_publisher(PointCloud2, 'tool/flux', qos.STREAM)
        self.reference = self.peer.create_publisher(PointCloud2, 'reference/flux', qos.STREAM)
        self.model = self.peer.create_publisher(PointCloud2, 'field_model', qos.LATCHED)
        self.poses, self.full, self.models, self.errors, self.states = {}, {}, [], [], {}
        for name in (*SENSORS.name, BODY):
            stem = name.replace('/0/', '_0/').replace('/1/', '_1/').replace('/2/', '_2/')
            self.peer.create_subscription(
                PoseStamped, f'{stem}/pose', self._keep(self.poses, name), 10
            )
            self.peer.create_subscription(
                PoseWithCovarianceStamped, f'{stem}/pose_with_covariance',
                self._keep(self.full, name), 10,
            )  # fmt: skip
        self.peer.create_subscription(PointCloud2, 'field_model', self.models.append, qos.LATCHED)
        self.peer.create_subscription(
            PointCloud2, 'field_model_error', self.errors.append, qos.LATCHED
        )
        self.peer.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.cloud = FluxCloud('fg')
        self.stamp_ns = FIRST_NS

    @staticmethod
    def _keep(box, name):
        def keep(message):
            box.setdefault(name, []).append(message)

        return keep

    def _on_diagnostics(self, message):
        for status in message.status:
            self.states[status.name] = (
                status.message, {item.key: item.value for item in status.values}
            )  # fmt: skip

    def state(self, name):
        return self.states.get(name, ('', {}))[0]

    def value(self, name, key):
        return self.states.get(name, ('', {}))[1].get(key, '')

    def spin_until(self, condition, timeout_s=10.0):
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, (self.node.counters, self.states)
            self.executor.spin_once(timeout_sec=0.02)

    def connect(self, *publishers):
        self.spin_until(
            lambda: all(publisher.get_subscription_count() > 0 for publisher in publishers)
        )

    def say_setup(self, text=None):
        from std_msgs.msg import String

        self.setup.publish(String(data=text or dump_setup(setup_of(SENSORS, reference_specs()))))

    def say_model(self, model, stamp_ns=5):
        from anser_ros.nodes.model_clouds import CloudMaker

        packed = encode_field_model(DipolePoints(model.positions, model.directions, model.moments))
        self.model.publish(CloudMaker().message(packed, 'fg', stamp_ns))

    def points(self, flux, flags=None, channels=None):
        count = len(flux)
        nothing = np.full((count, 3), np.nan)
        return FluxPoints(
            np.arange(count) if channels is None else channels,
            np.zeros(count, dtype=int) if flags is None else flags,
            flux, nothing, nothing,
        )  # fmt: skip

    def say_flux(self, flux, flags=None, stamp_ns=None):
        self.stamp_ns += 20_000_000
        stamp = self.stamp_ns if stamp_ns is None else stamp_ns
        message = self.cloud.message(self.points(flux, flags), stamp)
        self.flux.publish(message)
        return message


@pytest.fixture
def tracker(ros):
    from anser_ros.nodes.tracker import TrackerNode

    node = TrackerNode()
    bench = Bench(ros, node)
    bench.connect(bench.setup, bench.flux, bench.model)
    yield bench
    bench.executor.shutdown()
    node.destroy_node()
    bench.peer.destroy_node()


@pytest.fixture
def server(ros, tmp_path):
    """A field_model node that saves into the test's folder."""
    from rclpy.parameter import Parameter

    from anser_ros.nodes.field_model import FieldModelNode

    node = FieldModelNode(
        parameter_overrides=[
            Parameter('save_file', value=str(tmp_path / 'kept.yaml')),
            Parameter('baseline_s', value=0.2),
        ]
    )
    bench = Bench(ros, node)
    bench.connect(bench.setup, bench.reference)
    yield bench
    bench.executor.shutdown()
    node.destroy_node()
    bench.peer.destroy_node()


def axis_of(pose):
    q = pose.orientation
    return rotation_of_quaternion(np.array([q.x, q.y, q.z, q.w]))[:, 2]


def place_of(pose):
    return np.array([pose.position.x, pose.position.y, pose.position.z])


def wait_frame(bench, count):
    bench.spin_until(lambda: bench.node.counters['frames'] >= count)


def ready(bench):
    bench.say_setup()
    bench.say_model(certain_model())
    bench.spin_until(lambda: bench.node.counters['models'] >= 1)
    peer = bench.peer
    bench.spin_until(lambda: peer.count_publishers(f'/anser/{BODY}/pose') > 0)
    bench.spin_until(
        lambda: all(
            topic._pose.get_subscription_count() and topic._uncertain.get_subscription_count()
            for topic in bench.node._topics.values()
        )
    )


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


def test_two_publishers_give_no_poses_and_their_models_are_not_obeyed(tracker):
    from sensor_msgs.msg import PointCloud2

    from anser_ros.nodes import qos

    rng = np.random.default_rng(8)
    ready(tracker)
    node, first = tracker.node, tracker.flux
    places = [random_pose(rng) for _ in range(2)]

    def send(publisher, which):
        known = node.counters['frames']
        tracker.flux = publisher
        tracker.say_flux(fluxes(certain_model(), SENSORS, *places[which], rng))
        wait_frame(tracker, known + 1)

    for _ in range(3):
        send(first, 0)
    tracker.spin_until(
        lambda: len(tracker.full.get(BODY, [])) == len(tracker.poses.get(BODY, [])) == 3
    )
    for poses in (tracker.poses, tracker.full):
        tracker.spin_until(
            lambda poses=poses: all(len(poses.get(n, [])) == 3 for n in SENSORS.name)
        )
        poses.clear()
    second = tracker.peer.create_publisher(PointCloud2, 'tool/flux', qos.STREAM)
    tracker.connect(second)
    for _ in range(5):
        send(second, 1)
        send(first, 0)
    assert not tracker.poses, 'not even the first frame of the second one has a pose'
    assert node.status().message == 'two_sources: two publishers of tool/flux'
    assert int(node.status().level) == 2
    assert {part.message for part in node.part_statuses()} == {'two_sources'}
    # One goes; the other is believed within a second, whichever it was.
    tracker.peer.destroy_publisher(first)
    gone_s = time.monotonic()
    while not tracker.poses:
        assert time.monotonic() - gone_s < 1.3, node.status()
        send(second, 1)
    # Another model on the same topic is not obeyed, and whose holds is asked when one has gone.
    models = node.counters['models']
    other = tracker.peer.create_publisher(PointCloud2, 'field_model', qos.LATCHED)
    tracker.connect(other)
    mine, tracker.model = tracker.model, other
    wrong = certain_model()
    tracker.say_model(replace(wrong, moments=1.01 * wrong.moments), stamp_ns=9)
    tracker.spin_until(
        lambda: node.status().message.startswith('two_sources: two publishers of f')
    )
    tracker.spin_until(lambda: not tracker.executor.spin_once(timeout_sec=0.0))
    tracker.poses.clear()
    send(second, 1)
    assert node.counters['models'] == models
    assert not tracker.poses
    tracker.peer.destroy_publisher(other)
    tracker.model = mine
    tracker.spin_until(lambda: 'two_sources' not in node.status().message)
    tracker.spin_until(lambda: node._intake.newest.stamp_ns == 5)
    while not tracker.poses:
        send(second, 1)


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
    tracker.spin_until(lambda: f'anser/tracker: {BODY}' in tracker.states)
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
    tracker.spin_until(lambda: tracker.node._tracker is not None)
    tracker.say_flux(flux)
    wait_frame(tracker, 1)
    tracker.node.publish_diagnostics()
    tracker.spin_until(lambda: tracker.state('anser/tracker: tool_a') == 'no_model')
    assert tracker.state('anser/tracker') == 'no field model yet'
    time.sleep(0.4)
    tracker.node.publish_diagnostics()
    tracker.spin_until(lambda: tracker.state('anser/tracker: tool_a') == 'stale')


def test_refusals_are_counted_with_their_reason_and_tracking_goes_on(tracker):
    rng = np.random.default_rng(4)
    ready(tracker)
    model = certain_model()
    flux = fluxes(model, SENSORS, *random_pose(rng), rng)
    node = tracker.node

    def refused(counter, count, word):
        tracker.spin_until(lambda: node.counters[counter] == count)
        node.publish_diagnostics()
        tracker.spin_until(lambda: word in tracker.value('anser/tracker', 'last_refusal'))

    tracker.say_flux(flux, stamp_ns=0)
    refused('fluxes_refused', 1, 'no stamp')
    message = tracker.cloud.message(tracker.points(flux), 7)
    message.data = message.data[:-8]
    tracker.flux.publish(message)
    refused('fluxes_refused', 2, 'bytes')
    message = tracker.cloud.message(tracker.points(flux), 8)
    message.fields = [f for f in message.fields if f.name != 'coil3_im']
    tracker.flux.publish(message)
    refused('fluxes_refused', 3, 'coil3_im')
    message = tracker.cloud.message(tracker.points(flux[:, :5]), 9)
    tracker.flux.publish(message)
    refused('fluxes_refused', 4, '8 emitters')
    message = tracker.cloud.message(
        tracker.points(flux, channels=np.zeros(9, dtype=int)), FIRST_NS + 1
    )
    tracker.flux.publish(message)
    refused('fluxes_refused', 5, 'twice')
    tracker.say_model(model, stamp_ns=0)
    refused('models_refused', 1, 'no stamp')
    bad = model.positions.copy()
    bad[3, 1] = np.nan
    tracker.say_model(type(model)(bad, model.directions, model.moments, model.emitters,
                                  model.frequencies_hz), stamp_ns=8)  # fmt: skip
    refused('models_refused', 2, 'not finite')
    tracker.say_model(type(model)(model.positions, model.directions, model.moments[:, :3],
                                  model.emitters[:3], model.frequencies_hz[:3]),
                      stamp_ns=9)  # fmt: skip
    refused('models_refused', 3, '3 emitters')
    tracker.say_model(model, stamp_ns=10)
    tracker.say_setup('schema: anser_setup/1\nsensors: 5\n')
    refused('setups_refused', 1, 'sensors')
    tracker.say_setup('schema: [')
    refused('setups_refused', 2, 'YAML')
    before = node.counters['frames']
    tracker.say_flux(flux)
    wait_frame(tracker, before + 1)
    tracker.spin_until(lambda: BODY in tracker.poses)
    assert node.counters['callback_faults'] == 0


def test_a_jump_back_in_time_and_duplicates(tracker):
    rng = np.random.default_rng(6)
    ready(tracker)
    flux = fluxes(certain_model(), SENSORS, *random_pose(rng), rng)
    tracker.say_flux(flux)
    tracker.say_flux(flux, stamp_ns=tracker.stamp_ns)
    tracker.say_flux(flux, stamp_ns=FIRST_NS - 10**12)
    wait_frame(tracker, 3)
    counters = tracker.node._tracker.counters
    assert counters['duplicates'] == 1
    assert counters['time_jumps'] == 1
    tracker.spin_until(lambda: len(tracker.poses.get(BODY, [])) == 2)


def test_every_kind_of_bad_flux_has_its_counter(tracker):
    rng = np.random.default_rng(8)
    ready(tracker)
    flux = fluxes(certain_model(), SENSORS, *random_pose(rng), rng)
    node = tracker.node

    def send(values, **header):
        tracker.stamp_ns += 20_000_000
        message = tracker.cloud.message(tracker.points(values), tracker.stamp_ns)
        for name, value in header.items():
            setattr(message.header if name == 'frame_id' else message.header.stamp, name, value)
        tracker.flux.publish(message)

    bad = flux.copy()
    bad[0, 0], bad[1, 1] = np.inf, 1e20
    dead = flux.copy()
    dead[:, 6] = np.nan
    send(flux, frame_id='world')
    send(flux, nanosec=1_000_000_000)
    send(flux[:0])
    tracker.spin_until(lambda: node.counters['frames'] == 1)
    send(bad)
    message = tracker.cloud.message(tracker.points(flux), tracker.stamp_ns + 1)
    message.is_bigendian = True
    tracker.flux.publish(message)
    tracker.spin_until(lambda: node.counters['fluxes_big_endian'] == 1)
    send(dead)
    tracker.stamp_ns += 10**10
    send(dead)
    tracker.spin_until(lambda: node._tracker.counters['time_jumps_forward'] == 1)
    node.publish_diagnostics()
    # The words about the first frame without the emitter may still be on their way; only those
    # that know of the jump were published after the last frame.
    tracker.spin_until(lambda: tracker.value('anser/tracker', 'time_jumps_forward') == '1')
    assert tracker.value('anser/tracker', 'dead_emitters') == 'coil6'
    assert tracker.state('anser/tracker') == 'no flux of coil6'
    for counter, count in (
        ('fluxes_other_frame_id', 1), ('fluxes_without_stamp', 1), ('frames_empty', 1),
        ('readings_not_finite', 1), ('frames_dead_emitter', 2), ('fluxes_refused', 2),
        ('fluxes_big_endian', 1), ('time_jumps_forward', 1),
    ):  # fmt: skip
        assert tracker.value('anser/tracker', counter) == str(count), counter
    # The bytes that were called big endian make other channels.
    assert int(tracker.value('anser/tracker', 'readings_missing')) > 9
    assert int(tracker.value('anser/tracker', 'readings_absurd')) >= 1
    assert node.counters['callback_faults'] == 0


@pytest.mark.parametrize('live', [True, False])
def test_only_live_frames_too_fast_to_solve_are_skipped(tracker, monkeypatch, live):
    """A pause loses none, and neither does a recording that is played faster than it is solved."""
    from rclpy.parameter import Parameter

    rng = np.random.default_rng(9)
    if live:
        tracker.stamp_ns = time.time_ns()
    ready(tracker)
    tracker.node.set_parameters([Parameter('stale_after_s', value=30.0)])
    place = random_pose(rng)
    node, whole, pause_s = tracker.node, Tracker.estimates, [0.2]

    def slow(self, *arguments):
        time.sleep(pause_s.pop() if pause_s else work_s)
        return whole(self, *arguments)

    monkeypatch.setattr(Tracker, 'estimates', slow)
    work_s = 0.0
    for _ in range(20):
        tracker.say_flux(fluxes(certain_model(), SENSORS, *place, rng))
    wait_frame(tracker, 20)
    assert node.counters['frames_skipped'] == 0
    work_s, late_s = 0.05, []

    def send():
        for _ in range(100):
            time.sleep(0.02)
            tracker.say_flux(fluxes(certain_model(), SENSORS, *place, rng))
            late_s.append(1e-9 * (tracker.stamp_ns - node._tracker.last_stamp_ns))

    sender = threading.Thread(target=send)
    sender.start()
    tracker.spin_until(lambda: not sender.is_alive())
    tracker.spin_until(lambda: node._tracker.last_stamp_ns == tracker.stamp_ns)
    assert (node.counters['frames_skipped'] > 20) if live else not node.counters['frames_skipped']
    assert node.counters['frames_skipped'] + node.counters['frames'] == 120
    node.publish_diagnostics()
    said = 'computer too slow: '
    tracker.spin_until(lambda: (said in tracker.state('anser/tracker')) is live)
    assert tracker.value('anser/tracker', 'tracked') == '10'
    for topic in node._topics.values():
        topic.tally.latest_s -= 60.0
    node.publish_diagnostics()
    tracker.spin_until(lambda: tracker.value('anser/tracker', 'tracked') == '0')
    assert max(late_s) < 1.5
    if live:
        assert max(late_s[60:]) < 0.3, 'a backlog that is dropped does not grow'


def test_the_gate_may_change_while_it_runs(tracker):
    from rclpy.parameter import Parameter

    ready(tracker)
    results = tracker.node.set_parameters([Parameter('gate', value=7.5)])
    assert results[0].successful
    assert tracker.node._tracker.settings.gate == 7.5
    assert tracker.node.status().level == 0
    tracker.node.set_parameters([Parameter('gate', value=1e6)])
    assert tracker.node.status().level == 1 and 'gate of 1e+06' in tracker.node.status().message
    assert not tracker.node.set_parameters([Parameter('gate', value=-1.0)])[0].successful
    assert not tracker.node.set_parameters([Parameter('publish_tf', value=False)])[0].successful


def test_transforms_where_they_are_installed(tracker, monkeypatch):
    """Stands in for tf2_msgs, which the wheels don't have."""
    from anser_ros.nodes import pose_output

    sent = []
    monkeypatch.setattr(pose_output, 'TFMessage', lambda transforms: list(transforms))
    tracker.node._transforms = type('Publisher', (), {'publish': staticmethod(sent.append)})
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


def test_the_volume_of_the_setup_holds_unless_a_parameter_says_another(tracker):
    from anser_ros.nodes.tracker import TrackerParameters, settings_of

    rng, node = np.random.default_rng(8), tracker.node
    box = ((-0.1, -0.1, 0.2), (0.1, 0.1, 0.3))
    tracker.say_setup(dump_setup(replace(setup_of(SENSORS, reference_specs()), volume=box)))
    tracker.say_model(certain_model())
    tracker.spin_until(lambda: node.counters['models'] >= 1)
    tracker.say_flux(fluxes(certain_model(), SENSORS, np.array([0.0, 0.0, 0.15]), np.eye(3), rng))
    wait_frame(tracker, 1)
    node.publish_diagnostics()
    tracker.spin_until(lambda: tracker.state('anser/tracker: tool_a') == 'outside_volume')
    low, high = (-0.1, -0.1, 0.05), (0.1, 0.1, 0.3)
    stated = settings_of(TrackerParameters(volume_low_m=low, volume_high_m=high))
    assert settings_for(node._setup, stated).box == TrackedVolume(low, high)
    with pytest.raises(ParameterError, match='volume_high_m: three numbers'):
        settings_of(TrackerParameters(volume_low_m=low))


def test_a_wrong_parameter_ends_the_node_with_one_line(start):
    process = start('tracker', '--ros-args', '-p', 'volume_low_m:=[0.1]')
    assert process.popen.wait(20) == 2
    assert 'volume_low_m: three numbers needed' in process.output
    process = start('field_model', '--ros-args', '-p', 'model_file:=/dev/null')
    assert process.popen.wait(20) == 2
    assert 'schema' in process.output
    assert 'Traceback' not in process.output


def call(bench, kind, name, **request):
    client = bench.peer.create_client(kind, f'field_model/{name}')
    bench.spin_until(client.service_is_ready)
    future = client.call_async(kind.Request(**request))
    bench.spin_until(future.done, 30.0)
    bench.peer.destroy_client(client)
    return future.result()


def test_the_nominal_model_is_served_latched_with_its_uncertainty(server):
    from anser_ros.nodes.model_clouds import read_dipoles, read_error, stamp_of

    server.say_setup()
    server.spin_until(lambda: server.models and server.errors)
    points = read_dipoles(server.models[0])
    assert points.moments.shape == (144, 8)
    assert server.models[0].point_step == 8 * (6 + 16)
    assert stamp_of(server.models[0]) == stamp_of(server.errors[0]) > 0
    error = read_error(server.errors[0], 144, 8)
    assert error.modes.shape == (48, 144, 8)
    server.say_setup('schema: anser_setup/1\nsensors: []\n')
    server.spin_until(lambda: server.node.counters['setups_refused'] == 1)
    server.node.publish_diagnostics()
    server.spin_until(lambda: 'at least one' in server.state('anser/field_model'))


def test_services_of_the_field_model(server, tmp_path):
    from std_srvs.srv import SetBool, Trigger

    from anser_ros.nodes.model_clouds import stamp_of
    from anser_ros.sessions.session import sensor_table

    assert not call(server, Trigger, 'reset').success, 'there is no model yet'
    assert not call(server, Trigger, 'save').success
    assert not call(server, Trigger, 'set_baseline').success
    server.say_setup()
    server.spin_until(lambda: len(server.models) == 1)
    reply = call(server, Trigger, 'set_baseline')
    assert not reply.success
    assert 'frames' in reply.message
    references = sensor_table(reference_specs())
    clean = certain_model().flux(references.position, references.axis)
    for i in range(8):
        points = server.points(clean, channels=references.channel)
        server.reference.publish(server.cloud.message(points, FIRST_NS + i * 40_000_000))
    server.spin_until(lambda: server.node.counters['frames'] == 8)
    reply = call(server, Trigger, 'set_baseline')
    assert reply.success, reply.message
    assert reply.message.startswith('baseline of 8 references')
    assert call(server, SetBool, 'freeze', data=True).message == 'the model stays as it is'
    assert call(server, SetBool, 'freeze', data=False).message == 'the model may change'
    reply = call(server, Trigger, 'save')
    assert reply.message == str(tmp_path / 'kept.yaml')
    kept = load_model(reply.message)
    assert kept.moments.shape == (144, 8)
    before = stamp_of(server.models[-1])
    assert call(server, Trigger, 'reset').success
    server.spin_until(lambda: stamp_of(server.models[-1]) > before)
    assert server.node.counters['callback_faults'] == 0


def test_the_nominal_model_is_no_file(ros):
    from rclpy.parameter import Parameter

    from anser_ros.nodes.tracker import TrackerNode

    node = TrackerNode(parameter_overrides=[Parameter('model_file', value='nominal')])
    assert node.status().message == 'no setup yet'
    node.destroy_node()


def test_a_model_file_is_served_at_once_and_must_fit_the_setup(ros, tmp_path):
    from rclpy.parameter import Parameter

    from anser_ros.nodes.field_model import FieldModelNode

    model = certain_model()
    other = type(model)(
        model.positions, model.directions, model.moments,
        ('a', 'b', 'c', 'd', 'e', 'f', 'g', 'h'), model.frequencies_hz,
    )  # fmt: skip
    save_model(tmp_path / 'other.yaml', other)
    node = FieldModelNode(
        parameter_overrides=[Parameter('model_file', value=str(tmp_path / 'other.yaml'))]
    )
    bench = Bench(ros, node)
    try:
        bench.connect(bench.setup)
        bench.spin_until(lambda: bool(bench.models))
        bench.say_setup()
        bench.spin_until(lambda: node.counters['setups_refused'] == 1)
        node.publish_diagnostics()
        bench.spin_until(lambda: 'emitters' in bench.state('anser/field_model'))
    finally:
        bench.executor.shutdown()
        node.destroy_node()
        bench.peer.destroy_node()


def test_both_nodes_track_a_recorded_session(ros, shared):
    """The chain of field_model and tracker on a recording that this package did not make."""
    from rclpy.parameter import Parameter

    from anser_ros.nodes.field_model import FieldModelNode
    from anser_ros.nodes.tracker import TrackerNode
    from anser_ros.sessions.session import load_session

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
            lambda: node.counters['models'] >= 1 and node._tracker.model.modes is not None
        )
        bench.spin_until(
            lambda: all(t._pose.get_subscription_count() for t in node._topics.values())
        )
        for frame in range(0, 60, 2):
            bench.say_flux(tool.flux[frame], stamp_ns=session.start_ns + round(4e7 * frame) + 1)
        bench.spin_until(lambda: len(bench.full.get(BODY, [])) >= 30)
    finally:
        bench.executor.shutdown()
        for one in (server, node):
            one.destroy_node()
        bench.peer.destroy_node()
    for frame, message in zip(range(0, 60, 2), bench.full[BODY], strict=True):
        away = np.linalg.norm(place_of(message.pose.pose) - tool.position[frame])
        sigma = np.sqrt(np.trace(message.pose.covariance.reshape(6, 6)[:3, :3]))
        assert away < 4e-3, 'a drawn board is good to a few millimetres'
        assert away < 4.0 * np.hypot(sigma, 0.12e-3), 'and it knows'
