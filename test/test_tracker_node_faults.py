"""The node tracker over DDS and what it cannot use: other publishers, bad frames, too many."""

import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import wait
from graph_bench import BODY, FIRST_NS, SENSORS, ready, tracker_bench, wait_frame
from sensor_msgs.msg import PointCloud2
from tracking_world import certain_model, fluxes, random_pose

from anser_ros.nodes.runtime import qos
from anser_ros.nodes.streams.one_source import Backlog
from anser_ros.tracking.tracker import Tracker

tracker = pytest.fixture(tracker_bench)


def test_two_publishers_give_no_poses_and_their_models_are_not_obeyed(tracker):
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
    # One goes; the other is believed after a while, whichever it was.
    tracker.peer.destroy_publisher(first)
    assert wait(lambda: tracker.poses, lambda: send(second, 1)), node.status()
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
    tracker.spin_until(lambda: node._given.stamp_ns == 5)
    assert wait(lambda: tracker.poses, lambda: send(second, 1))


def test_refusals_are_counted_with_their_reason_and_tracking_goes_on(tracker):
    ready(tracker)
    node, model, rng = tracker.node, certain_model(), np.random.default_rng(4)
    flux = fluxes(model, SENSORS, *random_pose(rng), rng)

    def refused(counter, count, word):
        tracker.spin_until(lambda: node.counters[counter] == count)
        node.publish_diagnostics()
        tracker.spin_until(lambda: word in tracker.value('anser/tracker', 'last_refusal'))

    def frame(stamp_ns, flux=flux, **more):
        return tracker.cloud.message(tracker.points(flux, **more), stamp_ns)

    cut, lacking = frame(7), frame(8)
    cut.data = cut.data[:-8]
    lacking.fields = [f for f in lacking.fields if f.name != 'coil3_im']
    twice = frame(FIRST_NS + 1, channels=np.zeros(9, dtype=int))
    wrong = (
        (frame(0), 'no stamp'), (cut, 'bytes'), (lacking, 'coil3_im'),
        (frame(9, flux[:, :5]), '8 emitters'), (twice, 'twice'),
    )  # fmt: skip
    for count, (message, word) in enumerate(wrong, 1):
        tracker.flux.publish(message)
        refused('fluxes_refused', count, word)
    bad = model.positions.copy()
    bad[3, 1] = np.nan
    three = replace(
        model, moments=model.moments[:, :3], emitters=model.emitters[:3],
        frequencies_hz=model.frequencies_hz[:3],
    )  # fmt: skip
    broken = (model, 0, 'no stamp'), (replace(model, positions=bad), 8, 'not finite')
    for count, (given, stamp_ns, word) in enumerate((*broken, (three, 9, '3 emitters')), 1):
        tracker.say_model(given, stamp_ns=stamp_ns)
        refused('models_refused', count, word)
    tracker.say_model(model, stamp_ns=10)
    texts = ('schema: anser_setup/1\nsensors: 5\n', 'sensors'), ('schema: [', 'YAML')
    for count, (text, word) in enumerate(texts, 1):
        tracker.say_setup(text)
        refused('setups_refused', count, word)
    before = node.counters['frames']
    tracker.say_flux(flux)
    wait_frame(tracker, before + 1)
    tracker.spin_until(lambda: BODY in tracker.poses)
    assert node.counters['callback_faults'] == 0


def test_bad_fluxes_have_their_counters_and_a_dead_emitter_is_named(tracker):
    """What there are counters for, `test_intake` and the field model's node have whole."""
    ready(tracker)
    node, rng = tracker.node, np.random.default_rng(8)
    flux = fluxes(certain_model(), SENSORS, *random_pose(rng), rng)
    bad, dead = flux.copy(), flux.copy()
    bad[0, 0], bad[1, 1] = np.inf, 1e20
    dead[:, 6] = np.nan
    elsewhere = tracker.cloud.message(tracker.points(flux), FIRST_NS + 1)
    elsewhere.header.frame_id = 'world'
    tracker.flux.publish(elsewhere)
    for values, later_ns in ((flux[:0], 0), (bad, 0), (dead, 0), (dead, 10**10)):
        tracker.stamp_ns += later_ns
        tracker.say_flux(values)
        wait_frame(tracker, 1)
    tracker.spin_until(lambda: node._half.tracker.counters['time_jumps_forward'] == 1)
    node.publish_diagnostics()
    # The words about the first frame without the emitter may still be on their way; only those
    # that know of the jump were published after the last frame.
    tracker.spin_until(lambda: tracker.value('anser/tracker', 'time_jumps_forward') == '1')
    assert tracker.value('anser/tracker', 'dead_emitters') == 'coil6'
    assert tracker.state('anser/tracker') == 'no flux of coil6'
    for counter, count in (
        ('fluxes_other_frame_id', 1), ('frames_empty', 1), ('readings_not_finite', 1),
        ('readings_absurd', 1), ('frames_dead_emitter', 2), ('fluxes_refused', 1),
    ):  # fmt: skip
        assert tracker.value('anser/tracker', counter) == str(count), counter
    assert node.counters['callback_faults'] == 0


@pytest.mark.parametrize('live', [True, False])
def test_only_live_frames_too_fast_to_solve_are_skipped(tracker, monkeypatch, live):
    """A pause loses none, and neither does a recording that is played faster than it is solved."""
    rng = np.random.default_rng(9)
    if live:
        tracker.stamp_ns = time.time_ns()
    ready(tracker)
    place = random_pose(rng)
    node, whole, pause_s = tracker.node, Tracker.update, [0.2]
    arrived, worked = Backlog.arrived, Backlog.worked

    def slow(self, *arguments, **options):
        time.sleep(pause_s.pop() if pause_s else work_s)
        return whole(self, *arguments, **options)

    monkeypatch.setattr(Tracker, 'update', slow)
    # How often frames come and what one costs is what the test says, however busy the machine is.
    monkeypatch.setattr(
        Backlog, 'arrived', lambda self, _, stamp_ns: arrived(self, stamp_ns, stamp_ns)
    )
    monkeypatch.setattr(Backlog, 'worked', lambda self, _: worked(self, max(work_s, 1e-3)))
    work_s = 0.0
    for _ in range(20):
        tracker.say_flux(fluxes(certain_model(), SENSORS, *place, rng))
    wait_frame(tracker, 20)
    assert node.counters['frames_skipped'] == 0
    work_s = 0.05

    for _ in range(100):
        tracker.say_flux(fluxes(certain_model(), SENSORS, *place, rng))
    tracker.spin_until(lambda: node._half.tracker._past.intake.last_ns == tracker.stamp_ns)
    assert (node.counters['frames_skipped'] > 20) if live else not node.counters['frames_skipped']
    assert node.counters['frames_skipped'] + node.counters['frames'] == 120
    node.publish_diagnostics()
    assert (node.counters['seconds_too_slow'] > 0) is live
    tracker.spin_until(
        lambda: tracker.value('anser/tracker', 'frames') == str(node.counters['frames'])
    )
    assert tracker.value('anser/tracker', 'tracked') == '10'
    for topic in node._topics.values():
        topic.latest_s -= 60.0
    node.publish_diagnostics()
    tracker.spin_until(lambda: tracker.value('anser/tracker', 'tracked') == '0')
