"""Acquisition and the simulated control unit as processes, joined by a pseudo-terminal and DDS."""

import os
import re
import time

import numpy as np
import pytest
from conftest import ask, diagnostics, spin_until
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros.errors import PortError, SetupError
from anser_ros.nodes.acquisition_status import clock_troubles
from anser_ros.nodes.acquisition_stream import FluxStream
from anser_ros.nodes.runtime import qos
from anser_ros.simulation.control_unit import Piece
from anser_ros.simulation.line import PseudoPort
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.frames import Channel, ChannelKind, Hello, SampleBlock
from anser_ros.wire.points import DROPPED, SATURATED, STALE, decode_flux
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config

SETUP = parse_setup(read_config('demo_setup.yaml'))
CHANNELS = parse_channels(read_config('demo_channels.yaml'))
NUMBERS = [sensor.channel for sensor in SETUP.sensors]
LASTING_S = {'unplug': 2.0, 'wrong_baud': 5.0}
"""From these faults on the period is longer, s: they last for half of it at most."""


def new_stream(numbers=NUMBERS, tones=SETUP.frequencies_hz, rate_hz=50.0):
    """Return the stream of a unit that says hello with these channels and tones."""
    channels = [Channel(n, ChannelKind.SENSE, 5.0) for n in numbers]
    current = Channel(99, ChannelKind.CURRENT, 2.5)
    hello = Hello('t', 40e3, 1e6, 40, (*channels, current), tones, (0.25,) * len(tones))
    return FluxStream(hello, SETUP, CHANNELS, 0.02, rate_hz)


class Listener:
    """Collects what acquisition says."""

    def __init__(self, ros, namespace='/anser'):
        self.node = ros.create_node('listener')
        self.tool, self.reference, self.setups, self.optical = [], [], [], []
        self.states = diagnostics(self.node)
        subscribe = self.node.create_subscription
        subscribe(PointCloud2, f'{namespace}/tool/flux', self._on_tool, qos.STREAM)
        subscribe(PointCloud2, f'{namespace}/reference/flux', self.reference.append, qos.STREAM)
        subscribe(String, f'{namespace}/setup', self.setups.append, qos.LATCHED)
        subscribe(PoseStamped, '/optical/tool_a/pose', self.optical.append, qos.STREAM)

    def _on_tool(self, message):
        self.tool.append((message, time.time()))

    def until(self, condition):
        assert spin_until(self.node, condition), self.states.get('anser/acquisition')

    def set(self, name, parameter, value):
        """Change a live parameter of a node."""
        changed = [Parameter(parameter, value=value).to_parameter_msg()]
        service = f'/anser/{name}/set_parameters'
        (result,) = ask(self.node, SetParameters, service, parameters=changed).results
        assert result.successful, result.reason

    def value(self, key, node='anser/acquisition'):
        return float(self.states.get(node, (0, '', {}))[2].get(key, 'nan'))


def points(message):
    fields = [(f.name, f.offset, f.datatype, f.count) for f in message.fields]
    return decode_flux(fields, message.point_step, message.width, bytes(message.data))


def stamp(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


@pytest.fixture
def chain(ros, start, tmp_path):
    """Simulator and acquisition, started with parameters; returns a listener and the processes."""

    def run(simulator=(), acquisition=()):
        link = tmp_path / 'cu'
        listener = Listener(ros)
        first = start('cu_simulator', '--ros-args', *_set(link=link), *_set(**dict(simulator)))
        second = start('acquisition', '--ros-args', *_set(device=link), *_set(**dict(acquisition)))
        return listener, first, second

    return run


def assert_on_grid(times, period_s):
    """A busy machine may skip windows; those that it gives are a whole number of periods apart,
    one after the other, but where the line of the clock began anew.
    """
    steps = np.diff(times) / period_s
    off = np.abs(steps - np.round(steps))
    assert ((steps > 0) | (off > 0.02)).all() and np.median(off) < 0.02, steps[steps < 0.5]


def _set(**parameters):
    return [word for k, v in parameters.items() for word in ('-p', f'{k}:={v}')]


def test_fluxes_arrive_with_layout_stamps_and_health(chain):
    listener, simulator, acquisition = chain({'metal': 'false'})
    listener.until(lambda: len(listener.tool) > 80 and len(listener.optical) > 50)
    messages, arrivals = zip(*listener.tool, strict=True)
    first = messages[0]
    assert (first.point_step, first.width, first.height) == (92, 9, 1)
    assert first.header.frame_id == 'fg' and not first.is_bigendian
    assert [f.name for f in first.fields[:10]] == [
        *('x', 'y', 'z', 'nx', 'ny', 'nz', 'channel', 'flags', 'coil0_re', 'coil0_im')
    ]
    tool, reference = points(messages[60]), points(listener.reference[60])
    assert tool.channel.tolist() == list(range(9)) and np.isnan(tool.position).all()
    assert reference.channel.tolist() == list(range(16, 48))
    spec = SETUP.reference_sensors[5]
    assert reference.position[5] == pytest.approx(spec.position_m, abs=1e-7)
    assert reference.axis[5] == pytest.approx(spec.axis, abs=1e-6)
    assert 1e-8 < np.abs(tool.flux).max() < 1e-4
    # a board without metal has no quadrature
    assert np.abs(reference.flux.imag).max() < 1e-3 * np.abs(reference.flux).max()
    times = np.array([stamp(m) for m in messages[20:]])
    assert_on_grid(times, 0.02)
    # a window's middle lies half a window behind its end; how long transport takes is no matter
    latency = np.array(arrivals[20:]) - times
    assert np.percentile(latency, 5) > 0.009
    told = parse_setup(listener.setups[-1].data)
    assert (told.sensors, told.emitter) == (SETUP.sensors, SETUP.emitter)
    assert 1e-11 < told.extra['flux_noise_t'] < 3e-10
    listener.until(lambda: 'anser/acquisition: emitter coil7' in listener.states)
    level, message, values = listener.states['anser/acquisition: emitter coil3']
    assert (level, message) == (0, 'driven')
    assert float(values['current_a']) == pytest.approx(0.25, rel=0.03)
    assert 1e-11 < float(values['flux_noise_t']) < 3e-10
    assert 'anser/acquisition: ref/15/1' in listener.states
    count = len(listener.setups)
    listener.set('acquisition', 'rate_hz', 200.0)
    listener.until(lambda: len(listener.setups) > count)
    assert parse_setup(listener.setups[-1].data).flux_rate_hz == 200.0
    fast = len(listener.tool) + 20
    listener.until(lambda: len(listener.tool) > fast + 100)
    times = np.array([stamp(m) for m, _ in listener.tool[fast:]])
    assert_on_grid(times, 0.005)
    for process in (acquisition, simulator):
        assert process.interrupt() == 0, process.output
        assert 'ERROR' not in process.output, 'what ends well is no fault of another process'


def test_every_fault_is_survived_counted_and_named(chain):
    """In the one line that an operator looks at: what, how often, and how grave."""
    slow = {'metal': 'false', 'sample_rate_hz': 20e3}
    listener, _, acquisition = chain({**slow, 'fault_period_s': 0.5})
    listener.until(lambda: len(listener.tool) > 10)

    def says(words, level):
        said = listener.states.get('anser/acquisition')
        return said is not None and re.search(words, said[1]) and said[0] >= level

    for fault, words, level, counter in (
        ('bad_crc', r'\d \(records with a wrong CRC\)', 1, 'bad_crc'),
        ('gap', r'\d \(blocks missing in the stream\)', 1, 'gap_blocks'),
        ('garbage', r'\d \(bytes of garbage\)', 1, 'skipped_bytes'),
        ('saturation', 'saturated: tool_a/0/x', 1, None),
        ('overrun', 'control unit: overrun, ', 1, 'device_dropped_blocks'),
        ('unplug', r'unplug \d+ \(cable pulled out\)', 2, 'unplug'),
        ('wrong_baud', r'wrong baud rate\?', 2, 'wrong_baud'),
        ('silence', r'silence \d+ \(nothing arrived\)', 2, 'silence'),
    ):
        if fault in LASTING_S:
            listener.set('cu_simulator', 'fault_period_s', LASTING_S[fault])
        listener.set('cu_simulator', 'fault', fault)
        listener.until(lambda w=words, at_least=level: says(w, at_least))
        assert counter is None or listener.value(counter) >= 1, fault
        listener.set('cu_simulator', 'fault', 'none')
        before = len(listener.tool)
        listener.until(lambda n=before: len(listener.tool) > n + 10)
    assert any(points(m).flags[0] & DROPPED for m, _ in listener.tool)
    assert any(points(m).flags.tolist() == [SATURATED] + 8 * [0] for m, _ in listener.tool)
    listener.until(lambda: listener.value('opens') >= 2)
    assert acquisition.popen.poll() is None


def test_a_port_that_is_not_there_and_a_setup_that_is_none(start, tmp_path, ros):
    listener = Listener(ros)
    start('acquisition', '--ros-args', *_set(device=tmp_path / 'absent'))
    listener.until(lambda: listener.value('open_failures') >= 2)
    level, _, values = listener.states['anser/acquisition']
    assert level == (1 if float(values['uptime_s']) < 3.0 else 2), 'a simulator may still start'
    listener.until(lambda: listener.states['anser/acquisition'][0] == 2)
    words = listener.states['anser/acquisition'][1]
    absent = tmp_path / 'absent'
    assert words == f'no port: cannot open {absent}: No such file or directory'
    broken = tmp_path / 'broken.yaml'
    broken.write_text('schema: something else')
    process = start('acquisition', '--ros-args', *_set(setup_file=broken))
    assert process.wait() == 2
    assert 'schema must be' in process.output and 'Traceback' not in process.output


class TestStream:
    """The part between port and topics, without processes."""

    def codes(self, seed=0, samples=40, columns=42):
        rng = np.random.default_rng(seed)
        return rng.integers(-500, 500, (samples, columns)).astype(np.int16)

    def push(self, stream, k, late_ms=0.0, **options):
        """Push the block that began after k ms; it comes at its end, or later."""
        block = SampleBlock(k, 1000 * k, self.codes(k))
        arrival_ns = 10**12 + round(10**6 * (k + 1 + late_ms))
        return stream.push([block], [arrival_ns], **options)

    def frames(self, stream, blocks, edit=lambda codes: None, skip=(), ticks=lambda k: 1000 * k):
        """Frames of blocks of 1 ms, after a start that was answered at once."""
        stream.restart(10**12)
        found = []
        for k in range(blocks):
            codes = self.codes(k)
            edit(codes)
            if k not in skip:
                arrival_ns = 10**12 + 10**6 * (k + 1)
                found += stream.push([SampleBlock(k, ticks(k), codes)], [arrival_ns])
        return found

    def test_flags(self):
        def edit(codes):
            codes[5, 2] = 32767
            codes[:, 4] = 17

        stream = new_stream()
        first, second = self.frames(stream, 40, edit, skip={25})
        assert first.tool.flags.tolist() == [0, 0, SATURATED, 0, STALE, 0, 0, 0, 0]
        assert (second.flags & DROPPED).all()
        assert first.host_ns == pytest.approx(10**12 + 10**7, abs=10**4)

    @pytest.mark.parametrize('column', [0, 20, 41])
    def test_a_column_that_repeats_itself_is_stale(self, column):
        """It says what it said 30 ms ago; where it is that of the currents, all fluxes are old."""

        blocks = iter(range(1000))

        def edit(codes):
            k = next(blocks)
            codes[:, column] = self.codes(k if k < 40 else 10 + (k - 40) % 30)[:, column]

        stream = new_stream()
        frames = self.frames(stream, 100, edit)
        stale = np.array([frame.flags & STALE > 0 for frame in frames])
        rows = slice(None) if column == 41 else [column]
        assert not stale[:2].any() and stale[2:, rows].all()
        assert stale[2:].sum() == 3 * (41 if column == 41 else 1)
        assert frames[-1].staleness.age_s[rows] == pytest.approx(0.03)
        assert not frames[-1].repeats

    def test_a_unit_that_repeats_itself_moves_no_clock(self):
        stream = new_stream()
        stream.restart(10**12)
        frames = []
        for k in range(400):
            codes = self.codes(k if k < 100 else k % 50)
            late_ns = 0 if k < 120 else 50_000_000
            arrival_ns = 10**12 + 10**6 * (k + 1) + late_ns
            frames += stream.push([SampleBlock(k, 1000 * k, codes)], [arrival_ns])
        assert [frame.repeats for frame in frames] == 5 * [False] + 15 * [True]
        assert all((frame.flags == STALE).all() for frame in frames[5:])
        assert frames[-1].host_ns == pytest.approx(10**12 + 390 * 10**6, abs=10**5)

    @pytest.mark.parametrize(
        ('ticks', 'words'),
        [
            (lambda k: 1000 * min(k, 30), 'stand still'),
            (lambda k: 2000 * k, 'run at 2 times'),
            (lambda k: 500 * k, 'run at 0.5 times'),
            (lambda k: 1010 * k, 'run at 1.01 times'),
            (lambda k: 1000 * k + 300_000 * (k > 195), 'jumped by 0.3 s'),
            (lambda k: 1000 * k if k < 195 else 1000 * (k - 195), 'jumped by -0.195 s'),
            (lambda k: (2**32 - 50_000 + 1000 * k) % 2**32, ''),
        ],
    )
    def test_ticks_move_no_stamps(self, ticks, words):
        stream = new_stream()
        frames = self.frames(stream, 200, ticks=ticks)
        assert len(frames) == 10
        times = np.array([frame.host_ns for frame in frames]) - 10**12
        assert times == pytest.approx(10**7 * (2 * np.arange(10) + 1), abs=10**5)
        assert stream.ticks.words.startswith(words) and bool(words) == bool(stream.ticks.words)
        assert stream.ticks.disagreements == bool(words)

    def test_a_late_window_waits_and_is_withheld(self):
        """While one waits it is looked after with every block."""
        stream = new_stream()
        assert len(self.frames(stream, 100)) == 5
        assert stream.blocks_wanted == 16
        assert not any(self.push(stream, k, 50) for k in range(100, 120))
        assert stream._waiting and stream.blocks_wanted == 1
        (frame,) = self.push(stream, 120)
        assert frame.host_ns == pytest.approx(10**12 + 110 * 10**6, abs=10**5)
        assert not any(self.push(stream, k, 900) for k in range(121, 160))
        assert stream.clock.is_doubted and not clock_troubles(stream), 'some came in time lately'
        assert not any(self.push(stream, k, 900) for k in range(160, 1000))
        assert stream.withheld > 20 and stream.clock.wants_answer
        assert clock_troubles(stream)[0][1] == 'clock: everything arrives 0.9 s late'

    def test_an_answer_behind_lost_blocks_moves_no_stamps(self):
        """A full line drops blocks, but no answer, and all that it carries is as late."""
        stream = new_stream()
        assert len(self.frames(stream, 100)) == 5
        assert not any(self.push(stream, k, 100) for k in range(100, 300))
        stream.answered(10**12 + 449 * 10**6)
        assert not any(self.push(stream, k, 100) for k in range(450, 3700))
        assert stream.clock.jumps == 0 and stream.clock.wants_answer

    def test_most_of_a_window_is_looked_at_before_its_end(self):
        """What repeats itself is searched for while the last blocks are still to come."""
        stream = new_stream()
        assert len(self.frames(stream, 100)) == 5
        assert not any(self.push(stream, k) for k in range(100, 100 + stream.blocks_wanted))
        assert stream.blocks_wanted == 4
        assert stream._watch._searched == stream._watch.position
        assert len([frame for k in range(116, 120) for frame in self.push(stream, k)]) == 1

    def test_windows_that_are_skipped_are_counted_and_cost_no_later_one(self):
        """A too slow computer takes the newest; what it passes over is not demodulated."""
        stream = new_stream()
        stream.restart(10**12)
        frames = []
        for k in range(100):
            frames += self.push(stream, k, skips=20 <= k < 80)
        assert [frame.host_ns for frame in frames] == pytest.approx(
            [10**12 + 10 * 10**6, 10**12 + 90 * 10**6], abs=10**5
        )
        assert (stream.counters.windows, stream.counters.windows_skipped) == (2, 3)

    @pytest.mark.parametrize('rate_hz', [50.0, 37.0, 400.0])
    def test_runs_of_blocks_give_what_single_blocks_give(self, rate_hz):
        """Whatever is lost, comes twice, is late or has wrong ticks."""
        order = [k for k in range(400) if k not in {31, 90} and not 120 < k < 160]
        order[200:200] = [order[199], order[150]]
        wrong = {300: 70_000, 301: 70_000}
        blocks = [SampleBlock(k, 1000 * k + wrong.get(k, 0), self.codes(k)) for k in order]
        read_ns = [10**12 + 10**6 * (3 * (k // 3) + 3 + 20 * (220 < k < 250)) for k in order]
        arrivals_ns = np.maximum.accumulate(read_ns).tolist()

        def found(most):
            stream, done, frames = new_stream(rate_hz=rate_hz), 0, []
            stream.restart(10**12)
            while done < len(blocks):
                count = stream.run_length(blocks[done : done + most])
                run = slice(done, done + count)
                frames += stream.push(blocks[run], arrivals_ns[run])
                done += count
            told = [(f.tool.flux.tobytes(), f.flags.tobytes(), f.repeats) for f in frames]
            faults = stream.clock.jumps, stream.withheld, stream.ticks.disagreements
            return told, faults, vars(stream.counters), [f.host_ns for f in frames]

        *single, stamps = found(1)
        *runs, others = found(30)
        assert runs == single and len(stamps) > 5
        assert others == pytest.approx(stamps, abs=2000)

    def test_a_restarted_stream_has_new_stamps(self):
        stream = new_stream()
        assert len(self.frames(stream, 110)) == 5
        frames = []
        for k in range(40):
            block = SampleBlock(k, 7000 + 1000 * k, self.codes(500 + k))
            frames += stream.push([block], [2 * 10**12 + 10**6 * (k + 1)])
        assert stream.counters.restarts == 1 and not frames, 'nothing bounds the new line yet'
        stream.answered(2 * 10**12 + 39 * 10**6)
        block = SampleBlock(40, 47_000, self.codes(540))
        (frame, _) = stream.push([block], [2 * 10**12 + 41 * 10**6])
        assert frame.host_ns == pytest.approx(2 * 10**12 + 10**7, abs=10**5)

    def test_what_does_not_fit_the_setup_is_named_left_alone_or_refused(self):
        stream = new_stream(NUMBERS[:-3])
        assert [s.name for s in stream.missing] == ['ref/14/1', 'ref/15/0', 'ref/15/1']
        assert len(stream.sensors) == 38
        assert stream.push([SampleBlock(0, 0, self.codes(columns=5))], [1]) == []
        with pytest.raises(SetupError, match='none of the channels'):
            new_stream([500])
        with pytest.raises(SetupError, match='drives 2 coils'):
            new_stream(tones=(6000.0, 7000.0))


def test_pseudo_port_leaves_what_is_not_its_own_alone(tmp_path):
    taken, link = tmp_path / 'file', tmp_path / 'cu'
    taken.write_text('mine')
    port = PseudoPort(link)
    terminal = os.readlink(link)
    for path, said in (
        (taken, 'is not a link'),
        (tmp_path / 'no' / 'folder', 'cannot make the link'),
        (link, 'another simulated control unit'),
    ):
        with pytest.raises(PortError, match=said):
            PseudoPort(path)
    assert taken.read_text() == 'mine' and os.readlink(link) == terminal
    port.close()
    PseudoPort(link).close()


def test_pseudo_port_drops_what_nobody_reads_and_removes_only_its_own_link(tmp_path):
    link = tmp_path / 'cu'
    port = PseudoPort(link)
    piece = Piece(bytes(4000), is_block=True)
    assert port.write([piece] * 800) > 100
    link.unlink()
    link.symlink_to('/dev/null')
    port.unplug()
    assert link.is_symlink() and not port.plugged
    assert port.write([piece]) == 1 and port.read() == b''
    port.plug()
    assert os.readlink(link) != '/dev/null'
    port.close()
    assert not link.is_symlink()
