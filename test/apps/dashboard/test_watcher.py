"""The watch over the last seconds: what it finds, on what, and that its word goes out again."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO, diagnostics, spin_until
from rclpy.parameter import Parameter
from std_msgs.msg import String

from anser_ros.apps.dashboard import watch as watching
from anser_ros.apps.dashboard.nodes.watcher import Watcher
from anser_ros.apps.dashboard.watch import LIVE, OPTICAL, RIGID, SlidingWindow, Watch
from anser_ros.errors import DiagnosisError
from anser_ros.field.model import EffectRecord
from anser_ros.nodes.streams.clouds import flux_cloud
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.session import empty_session, load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.bag import read_bag
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.cdr import read_cloud
from anser_ros.wire.points import FluxPoints

MODEL = REPO / 'config' / 'demo_model.yaml'
MOVING, FACTORY = (REPO / 'bags' / f'{name}.mcap' for name in ('moving', 'factory'))
CHANNEL, GAIN = 4, 0.97


def points(stream, row, gain=1.0):
    factor = np.where(stream.channel == CHANNEL, gain, 1.0)[:, None]
    nothing = np.full((stream.channel.size, 3), np.nan)
    return FluxPoints(
        stream.channel, stream.flags[row], stream.flux[row] * factor, nothing, nothing
    )


def filled(bag, *, gain=1.0, optical=True, length_s=20.0, frames=100, shift_ns=0, window=None):
    """A window into which a bag was played."""
    window = window or SlidingWindow(bag.setup, length_s, frames)
    for row, stamp in enumerate(bag.tool.stamp_ns.tolist()):
        window.take(window.tool, stamp + shift_ns, points(bag.tool, row, gain))
    for row, stamp in enumerate(bag.reference.stamp_ns.tolist()):
        window.take(window.reference, stamp + shift_ns, points(bag.reference, row))
    if optical:
        for body, track in bag.optical.items():
            rows = zip(track.stamp_ns.tolist(), track.position, track.quaternion, strict=True)
            for stamp, position, quaternion in rows:
                window.take_pose(body, stamp + shift_ns, (*position, *quaternion))
    return window


@pytest.fixture(scope='module')
def moving():
    return read_bag(MOVING)


@pytest.fixture
def watch(moving):
    empty = empty_session(moving.setup, LIVE)
    return Watch(prepare(empty, load_model(MODEL), load_session(FACTORY)))


class TestWindow:
    def test_keeps_so_many_frames_of_so_many_seconds(self, moving):
        window = filled(moving, length_s=4.0, frames=20)
        session = window.session()
        (tool,) = session.tools
        assert 18 <= tool.time.size <= 21 and np.diff(tool.time).min() > 0.19
        assert window.span_s == pytest.approx(4.0, abs=0.25)
        assert tool.has_pose.all()
        assert window.first_ns == moving.tool.stamp_ns[0] < session.start_ns
        rows = np.isin(moving.tool.stamp_ns, session.start_ns + np.round(1e9 * tool.time))
        assert np.array_equal(tool.flux, moving.tool.flux[rows])

    def test_begins_anew_when_time_runs_back(self, moving):
        window = filled(moving)
        filled(moving, window=window, shift_ns=-30 * SECOND_NS)
        assert window.restarts == 1
        assert window.first_ns == moving.tool.stamp_ns[0] - 30 * SECOND_NS
        assert window.session().tools[0].has_pose.all()

    def test_what_is_late_or_no_pose_is_left_out(self, moving):
        window = filled(moving)
        size = window.session().tools[0].time.size
        stamp = int(moving.tool.stamp_ns[-1])
        window.take(window.tool, stamp - SECOND_NS // 2, points(moving.tool, 0))
        window.take_pose('tool_a', stamp + SECOND_NS, (np.nan, 0, 0, 0, 0, 0, 1))
        window.take_pose('tool_a', stamp + SECOND_NS, (0, 0, 0, 0, 0, 0, 0.5))
        session = window.session()
        assert session.tools[0].time.size == size
        assert session.tools[0].track.time.size == moving.optical['tool_a'].stamp_ns.size

    def test_other_channels_begin_anew_and_before_there_is_nothing(self, moving):
        window = filled(moving, optical=False)
        fewer = replace(
            points(moving.tool, 0), channel=moving.tool.channel[:4],
            flux=moving.tool.flux[0][:4], flags=moving.tool.flags[0][:4],
        )  # fmt: skip
        window.take(window.tool, int(moving.tool.stamp_ns[-1]) + SECOND_NS, fewer)
        assert window.session().tools[0].time.size == 1
        assert SlidingWindow(moving.setup, 5.0, 50).session() is None


class TestWatch:
    @pytest.mark.parametrize('truth', [OPTICAL, RIGID])
    def test_all_is_well(self, moving, watch, truth):
        window = filled(moving, optical=truth == OPTICAL)
        seen = watch.look(window.session(), window.first_ns)
        assert seen.truth == truth and seen.is_clear and seen.findings == ()
        assert 0.7 < seen.excess < 1.2 and watch.searches == 0

    @pytest.mark.long
    @pytest.mark.parametrize('truth', [OPTICAL, RIGID])
    def test_a_gain_is_named_once_and_cleared(self, moving, watch, truth):
        optical = truth == OPTICAL
        window = filled(moving, gain=GAIN, optical=optical)
        for _ in range(2):
            seen = watch.look(window.session(), window.first_ns)
            (found,) = seen.findings
            assert seen.truth == truth and not seen.is_clear
            assert found.name == 'sensor_gain' and found.parameters['channel'] == CHANNEL
            assert found.parameters['gain'] == pytest.approx(GAIN, abs=1e-3)
            assert seen.excess > 100 and seen.excess_left < 1.25
        assert watch.searches == 1, 'what explains the residual still is not searched for again'
        window = filled(moving, optical=optical, window=window, shift_ns=30 * SECOND_NS)
        assert watch.look(window.session(), window.first_ns).is_clear

    def test_a_tool_at_rest_shows_that_but_not_what(self, moving, watch):
        tool = moving.tool
        # At rest, not stuck: each frame has noise of its own.
        noise = np.random.default_rng(3).normal(scale=60e-12, size=(2, *tool.flux.shape))
        still = replace(tool, flux=tool.flux[:1] + noise[0] + 1j * noise[1])
        at_rest = replace(moving, optical={}, tool=still)
        window = filled(at_rest, gain=0.9, optical=False)
        seen = watch.look(window.session(), window.first_ns)
        assert seen.excess > 10 and seen.findings == () and not seen.is_clear
        assert 'moves too little' in seen.remark and watch.searches == 0

    def test_a_bend_that_stays_is_named(self, moving, watch):
        (tool,), model, flux = (
            load_session(MOVING).tools,
            load_model(MODEL),
            moving.tool.flux + 0.0,
        )
        aside = np.where(np.arange(9)[:, None] < 3, [0.0018, 0.0024, 0.0], 0.0)
        for f, (place, turn) in enumerate(zip(tool.position, tool.rotation, strict=True)):
            own, length = tool.sensors.axis @ turn.T, tool.sensors.length
            for sign, local in (
                (1.0, tool.sensors.position + aside),
                (-1.0, tool.sensors.position),
            ):
                flux[f] += sign * model.flux(local @ turn.T + place, own, length)
        window = filled(replace(moving, tool=replace(moving.tool, flux=flux)), optical=False)
        (found,) = watch.look(window.session(), window.first_ns).findings
        assert (found.name, found.parameters['channels']) == ('sensor_position', [0, 1, 2])
        assert found.parameters['offset_m'] == pytest.approx(aside[0], abs=2e-5)

    def test_too_few_frames_are_refused(self, moving, watch):
        window = filled(moving, length_s=1.0, frames=20)
        with pytest.raises(DiagnosisError, match='at least 30 frames'):
            watch.look(window.session(), window.first_ns)

    @pytest.mark.parametrize('optical', [True, False])
    def test_an_effect_that_the_model_corrects_is_none(self, moving, optical):
        window = filled(moving, gain=GAIN, optical=optical)
        parameters = {'channel': CHANNEL, 'gain': GAIN, 'phase_deg': 0.0}
        known = EffectRecord('sensor_gain', parameters)
        model = replace(load_model(MODEL), effects=(known,))
        assert (
            Watch(prepare(empty_session(moving.setup, LIVE), model))
            .look(window.session(), window.first_ns)
            .is_clear
        )

    def test_what_nothing_explains_is_not_given_a_name(self, moving, watch, monkeypatch):
        nothing = replace(watching.LIGHT_SEARCH, most_effects=0)  # as if no effect explained it
        monkeypatch.setattr(watching, 'LIGHT_SEARCH', nothing)
        window = filled(moving, gain=GAIN)
        seen = watch.look(window.session(), window.first_ns)
        assert seen.findings == () and not seen.is_clear and seen.excess_left > 100
        assert seen.depends_on


def write_changing(path, bag, rounds):
    """A bag of several rounds of a session, the first with a wrong gain."""
    length = int(bag.tool.stamp_ns[-1] - bag.tool.stamp_ns[0]) + SECOND_NS // 25
    with SessionWriter(path) as writer:
        writer.write_setup(bag.setup_text, int(bag.tool.stamp_ns[0]))
        for number in range(rounds):
            for row, stamp in enumerate(bag.tool.stamp_ns.tolist()):
                cloud = points(bag.tool, row, GAIN if number == 0 else 1.0)
                sensors = bag.setup.tool_sensors
                writer.write_readings(sensors, stamp + number * length, cloud.flux)
            for body, track in bag.optical.items():
                rows = zip(track.stamp_ns.tolist(), track.position, track.quaternion, strict=True)
                for stamp, position, quaternion in rows:
                    writer.write_pose(
                        f'/optical/{body}/pose', stamp + number * length, position, quaternion
                    )
    return path


def test_over_dds_a_finding_is_raised_and_cleared(ros, start, moving, tmp_path):
    bag = write_changing(tmp_path / 'changing.mcap', moving, rounds=4)
    node = ros.create_node('listener')
    lines = diagnostics(node)
    watcher = start(
        'watcher', '--ros-args', '-p', f'model_file:={MODEL}', '-p', 'window_s:=5.0',
        '-p', 'period_s:=0.5', '-p', 'cpu_share:=1.0',
    )  # fmt: skip
    start('replay', bag, '--rate', '2', '--loop', '--wait', '4')
    title = f'anser/watcher: sensor_gain (channel {CHANNEL})'

    def is_raised():  # with few optical poses on a busy machine, tools are all there is
        own = lines.get('anser/watcher', (0, '', {}))[2]
        return lines.get(title, (0,))[0] == 1 and own.get('compared_with') == OPTICAL

    assert spin_until(node, is_raised), f'{lines}\n{watcher.output}'
    _, message, values = lines[title]
    assert abs(float(values['gain']) - GAIN) < 2e-3 and 'gain' in message
    assert float(values['gain_sigma']) < 1e-3 and 'summary' in values
    own = lines['anser/watcher']
    assert own[0] == 1 and own[1].startswith('sensor_gain (channel 4)')

    def is_cleared():
        return lines[title][:2] == (0, 'gone') and lines['anser/watcher'][0] == 0

    assert spin_until(node, is_cleared), f'{lines}\n{watcher.output}'
    assert 'nothing found' in lines['anser/watcher'][1]
    published = {
        name for name, _ in node.get_publisher_names_and_types_by_node('watcher', '/anser')
    }
    assert '/diagnostics' in published
    assert published <= {'/diagnostics', '/rosout', '/parameter_events'}, 'it only speaks there'
    assert watcher.interrupt() == 0


def test_fluxes_of_another_frame_are_counted_and_not_looked_at(ros, moving):
    node = Watcher(parameter_overrides=[Parameter('model_file', value=str(MODEL))])
    try:
        streams = node._streams
        streams.on_setup(String(data=moving.setup_text))
        for frame_id in ('world', moving.setup.frame_id):
            for stream, topic in (
                (moving.tool, 'tool/flux'),
                (moving.reference, 'reference/flux'),
            ):
                cloud = flux_cloud(points(stream, 0), frame_id, int(stream.stamp_ns[0]))
                streams.on_fluxes(topic, read_cloud(cloud))
            if frame_id == 'world':
                assert streams.window.session() is None
                assert node.counters['fluxes_other_frame_id'] == 2
                assert "fluxes in the frame 'world'" in node._trouble.last
        assert node.counters['frames'] == node.counters['fluxes_refused'] == 2
        assert streams.window.session() is not None
    finally:
        node.close()
        node.destroy_node()


def test_over_dds_on_a_session_that_this_package_did_not_make(ros, start, shared, effects_model):
    folder = shared / 'sessions' / 'effects'
    node = ros.create_node('listener')
    lines = diagnostics(node)
    watcher = start(
        'watcher', '--ros-args', '-p', f'model_file:={effects_model}',
        '-p', f'baseline_file:={folder / "factory.mcap"}', '-p', 'cpu_share:=1.0',
    )  # fmt: skip
    start('replay', folder / 's02.mcap', '--rate', '4', '--loop', '--wait', '0.2')
    title = 'anser/watcher: sensor_gain (channel 0)'
    raised = spin_until(node, lambda: lines.get(title, (0,))[0] == 1)
    assert raised, f'{lines}\n{watcher.output}'
    assert float(lines[title][2]['gain']) == pytest.approx(0.98242, abs=1e-3)


def test_a_baseline_that_is_none_is_refused(start):
    """Said in one line, before anything runs."""
    watcher = start('watcher', '--ros-args', '-p', 'baseline_file:=nowhere.mcap')
    assert watcher.wait() == 2
    assert 'baseline_file: no file nowhere.mcap' in watcher.output
