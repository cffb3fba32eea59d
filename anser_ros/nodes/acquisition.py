"""Turns samples of a control unit's serial port into fluxes. The port's thread reads and queues,
this node's worker demodulates and publishes, the executor serves parameters and diagnostics; none
waits for another.
"""

import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros.chain.frame import ChainFrame
from anser_ros.errors import AnserError, PortError
from anser_ros.nodes import acquisition_status
from anser_ros.nodes.acquisition_stream import FluxFrame, FluxStream, MeasuredAccuracy, WallClock
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import from_text, parameter, prefix_parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.streams.clouds import flux_cloud, readings_of
from anser_ros.nodes.streams.one_source import Backlog, too_slow
from anser_ros.parallel import TURN_S
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.frames import (
    TYPE_OF,
    DeviceStatus,
    Hello,
    Identify,
    Record,
    Reply,
    ReplyCode,
    SampleBlock,
    Start,
)
from anser_ros.wire.points import as_sent
from anser_ros.wire.port import (
    DEFAULT_BAUD,
    SILENCE_S,
    Batch,
    ControlUnitPort,
    PortState,
    find_port,
)
from anser_ros.wire.protocols import PROTOCOLS, StreamControl
from anser_ros.wire.setup import Setup, dump_setup, parse_setup

if TYPE_CHECKING:
    from anser_ros.chain.chain import Chain


@dataclass(frozen=True)
class AcquisitionParameters:
    device: str = parameter(
        '/dev/ttyACM0', "the control unit's port, or auto: listen on all ports for its hello"
    )
    frame_prefix: str = prefix_parameter()
    protocol: str = parameter('anser', 'protocol of the control unit', choices=tuple(PROTOCOLS))
    baud: int = parameter(
        DEFAULT_BAUD, 'baud rate of the line; ignored over USB', within=(9600, 50_000_000)
    )
    setup_file: str = parameter('demo_setup.yaml', 'setup document: a path, or a file of config/')
    channels_file: str = parameter(
        'demo_channels.yaml', 'channel calibration: a path, or a file of config/'
    )
    window_s: float = parameter(
        0.02, 'length of a demodulation window, s', within=(0.005, 0.05), live=True
    )
    rate_hz: float = parameter(
        0.0,
        'windows a second, may overlap; 0 for the rate of the setup document',
        within=(0.0, 1000.0),
        live=True,
    )
    mains_hz: float = parameter(
        0.0, 'mains whose harmonics are fitted too; 0 for none', within=(0.0, 400.0), live=True
    )
    set_frequencies: bool = parameter(
        True, 'whether the tones of the setup document are set on the control unit'
    )
    silence_s: float = parameter(
        SILENCE_S, 'time without a byte after which it reports a fault, s', within=(0.1, 60.0)
    )


AUTO = 'auto'
ASK_NS = 50_000_000
"""Time (50 ms) between questions about the device's time, while windows wait for its answer."""
START_S = 3.0
"""Time, s, that a port has to be there: a simulator is started at the same time."""
WAIT_S = 0.1
"""Longest wait for blocks, s: how late the end of the node or a change is noticed in a silence."""


class Acquisition(AnserNode):
    """Publishes ``setup``, ``tool/flux`` and ``reference/flux``.

    ``chain`` is what it takes frames through itself, where other nodes of its process do that.
    """

    NAME = 'acquisition'
    EXAMPLE = '--ros-args -p device:=/dev/ttyACM0 -p setup_file:=config/demo_setup.yaml'
    PARAMETERS = AcquisitionParameters

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        table = self.parameters
        self._setup = from_text('setup_file', table.setup_file, parse_setup)
        self._frame_id = f'{table.frame_prefix}{self._setup.frame_id}'
        self._calibration = from_text('channels_file', table.channels_file, parse_channels)
        self._setup_publisher = self.create_publisher(String, 'setup', qos.LATCHED)
        self._tool_publisher = self.create_publisher(PointCloud2, 'tool/flux', qos.STREAM)
        self._reference_publisher = self.create_publisher(
            PointCloud2, 'reference/flux', qos.STREAM
        )
        may_set = table.set_frequencies and PROTOCOLS[table.protocol].sets_tones
        self._control = StreamControl(self._setup.frequencies_hz, set_frequencies=may_set)
        self._hello: Hello | None = None
        self._device: DeviceStatus | None = None
        self._stream: FluxStream | None = None
        self._refusal = ''
        self._rebuild = False
        self._frame: FluxFrame | None = None
        self._interval = self._last = acquisition_status.Interval(time.monotonic())
        self._past: Counter[str] = Counter()
        self._backlog = Backlog()
        self._published_setup = ''
        self._logged: Level | None = None
        self._accuracy = MeasuredAccuracy()
        self._wall_clock = WallClock()
        self._asked_ns = 0
        self._start_sent_ns: int | None = None
        self.chain: Chain | None = None
        self._faults = acquisition_status.RecentFaults()
        self._publish_setup(self._setup)
        self._port: ControlUnitPort | None = None
        self._closing = threading.Event()
        self._worker = threading.Thread(target=self._work, name='demodulation')
        self._worker.start()

    # Worker thread ------------------------------------------------------------------------

    def _work(self) -> None:
        step = self._guard(self._step)
        while not self._closing.is_set():
            step()
        if self._port is not None:
            self._port.end_stream()
            self._port.stop()

    def _step(self) -> None:
        """Take one batch from the port, or find the port first."""
        port = self._port
        if port is None:
            self._open()
            return
        batch = port.get(WAIT_S)
        if batch is not None:
            self._take(batch, port)
        stream, now_ns = self._stream, time.monotonic_ns()
        command = self._control.due(now_ns)
        if command is not None and port.state not in (PortState.ABSENT, PortState.CLOSED):
            port.send(command)
        wants_answer = stream is not None and stream.clock.wants_answer
        is_due = wants_answer and now_ns - self._asked_ns > ASK_NS
        if is_due and port.state is PortState.RECEIVING:
            self._asked_ns = now_ns
            port.send(Identify())  # from its answer follows what time it is for the device

    def _open(self) -> None:
        table = self.parameters
        device, protocol = table.device, PROTOCOLS[table.protocol]
        if device == AUTO:
            try:
                device = find_port(protocol=protocol, baud=table.baud)
            except PortError as error:
                self._refusal = str(error)
                self._closing.wait(1.0)
                return
            self._refusal = ''
        port = ControlUnitPort(
            device, protocol=protocol, baud=table.baud, silence_s=table.silence_s
        )
        port.start()
        self._port = port

    def _take(self, batch: Batch, port: ControlUnitPort) -> None:
        if not batch.records:
            self._control.reset()
            self._drop_stream()
            return
        pairs = zip(batch.records, batch.arrivals_ns, strict=True)
        for is_block, group in groupby(
            pairs, lambda pair: isinstance(pair[0].payload, SampleBlock)
        ):
            records, arrivals_ns = zip(*group, strict=True)
            for record, arrival_ns in zip(records, arrivals_ns, strict=True):
                self._control.take(record, arrival_ns)
                if not is_block:
                    self._dispatch(record)
            if is_block and self._control.started:  # else they are left over in a buffer
                self._take_blocks([record.payload for record in records], arrivals_ns)
        stream = self._stream
        port.want(*(1, 0.0) if stream is None else (stream.blocks_wanted, stream.block_s))

    def _dispatch(self, record: Record) -> None:
        payload = record.payload
        if isinstance(payload, Hello):
            if payload != self._hello:
                self._drop_stream()
            self._hello = payload
        elif isinstance(payload, DeviceStatus):
            self._device = payload
        elif isinstance(payload, Reply) and payload.code is ReplyCode.OK:
            self._take_answer(payload.command, record.tag)

    def _take_blocks(self, blocks: Sequence[SampleBlock], arrivals_ns: Sequence[int]) -> None:
        """Publish the frames that blocks complete; those late beyond hope give way to newer."""
        if self._rebuild:
            self._drop_stream()
        if self._stream is None and not self._refusal:
            self._make_stream()
        stream, done = self._stream, 0
        while stream is not None and done < len(blocks):
            begin_ns = time.monotonic_ns()
            run = slice(done, done + stream.run_length(blocks[done:]))
            done, arrival_ns = run.stop, arrivals_ns[run.stop - 1]
            skips = self._backlog.is_hopeless((begin_ns - arrival_ns) / 1e9)
            for frame in stream.push(blocks[run], arrivals_ns[run], skips=skips):
                could_wait = self._publish_frame(stream, frame, arrival_ns)
                now_ns = time.monotonic_ns()
                if not could_wait:  # whether a backlog is hopeless depends on all other work
                    self._backlog.worked((now_ns - begin_ns) / 1e9)
                begin_ns = now_ns

    def _take_answer(self, command: int, tag: int) -> None:
        """Take from an answer that what follows it was sampled after the command had left."""
        sent_ns = self._port.sent_ns(tag) if self._port is not None else None
        if command == TYPE_OF[Start]:
            self._start_sent_ns = sent_ns
            if self._stream is not None:
                self._stream.restart(sent_ns)
        elif sent_ns is not None and self._stream is not None:
            self._stream.answered(sent_ns)

    def _drop_stream(self) -> None:
        """Forget windows and refusal; the next block makes a new stream."""
        if self._stream is not None:
            self._past.update(self._stream.counts())
        self._stream, self._refusal, self._rebuild = None, '', False

    def _make_stream(self) -> None:
        if self._hello is None or not self._control.tones_agree:
            return
        try:
            self._stream = self._new_stream(self._hello)
        except AnserError as error:
            self._refusal = str(error)
            raise
        self._accuracy = MeasuredAccuracy()
        self._backlog = Backlog(1 / self._stream.rate_hz)
        if self._start_sent_ns is not None:
            self._stream.clock.bound(0, self._start_sent_ns)

    def _new_stream(self, hello: Hello) -> FluxStream:
        table = self.parameters
        rate_hz = table.rate_hz or self._setup.flux_rate_hz
        timing = table.window_s, rate_hz, table.mains_hz
        return FluxStream(hello, self._setup, self._calibration, *timing)

    def _publish_setup(self, setup: Setup) -> None:
        text = dump_setup(setup)
        if text != self._published_setup:
            self._published_setup = text
            self._setup_publisher.publish(String(data=text))

    def _publish_frame(self, stream: FluxStream, frame: FluxFrame, arrival_ns: int) -> bool:
        """Publish a frame, and take it through the chain; return whether its model was refitted,
        which is left out, but for every third frame, when the next window is near or waits.
        """
        reference = None
        if self._accuracy.must_republish(frame, stream.clock.sigma_s, time.monotonic()):
            self._publish_setup(self._accuracy.stated_in(self._setup, stream.rate_hz))
        # The system's clock may be set while we run; the offset is taken again for every stamp.
        stamp_ns = frame.host_ns + self._wall_clock.offset_ns()
        if self.chain is not None:
            late = self._backlog.gives_way((time.monotonic_ns() - arrival_ns) / 1e9)
            self.count('refits_left_out', late)
            tools, reference = (
                readings_of(as_sent(points)) if len(points.channel) else None
                for points in (frame.tool, frame.reference)
            )
            reference = None if late else reference
            self.chain.step(ChainFrame(stamp_ns, tools, reference))
        publishers = self._tool_publisher, self._reference_publisher  # poses come first
        for publisher, points in zip(publishers, (frame.tool, frame.reference), strict=True):
            if len(points.channel) and publisher.get_subscription_count():
                publisher.publish(flux_cloud(points, self._frame_id, stamp_ns))
        self._frame = frame
        self._interval.add(frame, (time.monotonic_ns() - arrival_ns) / 1e9)
        return reference is not None

    # Executor thread ----------------------------------------------------------------------

    def on_parameters(self, old: Any, new: Any) -> None:
        """Demodulate the new way from the next block on; what cannot be done is refused."""
        if self._hello is not None and self._stream is not None:
            self._new_stream(self._hello)
        self._rebuild = True

    def close(self) -> None:
        self._closing.set()
        self._worker.join(2.0)

    def on_abandon(self) -> None:
        """Command the control unit to stop, whatever the other threads are at."""
        self._closing.set()
        if self._port is not None:
            self._port.end_stream()

    def status(self) -> Status:
        interval, self._interval = self._interval, acquisition_status.Interval(time.monotonic())
        self._last = interval
        elapsed = max(self._interval.begin_s - interval.begin_s, 1e-3)
        values: dict[str, object] = {
            'rate_hz': interval.frames / elapsed,
            'processing_ms_mean': 1e3 * interval.delay_sum_s / max(interval.frames, 1),
            'processing_ms_max': 1e3 * interval.delay_max_s,
        }
        port, stream, device = self._port, self._stream, self._device
        if port is not None:
            values |= {'device': port.device, 'port': port.state.value, **port.fault_counters()}
        totals = self._past.copy()
        if stream is not None:
            totals.update(stream.counts())
            clock = stream.clock
            values |= {'clock': clock.state.value, 'lateness_s': clock.lateness_s}
            values['stamp_sigma_s'] = clock.sigma_s
        values['system_clock_set'] = self._wall_clock.sets
        values |= totals
        if device is not None:
            values |= {
                'device_state': device.state.name.lower(),
                'device_flags': acquisition_status.device_words(device) or 'none',
                'device_dropped_blocks': device.dropped_blocks,
                'device_temperature_deg_c': device.temperature_deg_c,
            }
        counters = {name: count for name, count in values.items() if isinstance(count, int)}
        rises = self._faults.note(counters, time.monotonic())
        level, message = self._verdict(interval, rises)
        self._log_change(level, message)
        return Status('', level, message, values)

    def _log_change(self, level: Level, message: str) -> None:
        """Write on the console when an error begins, and when all is well (again)."""
        if level is self._logged or level not in (Level.OK, Level.ERROR) or self._closing.is_set():
            return  # at the end the unit may have gone before
        self._logged = level
        device = self.parameters.device if self._port is None else self._port.device
        if level is Level.OK:
            self.get_logger().info(f'{device}: {message}')
        else:  # rclpy allows one severity a line of code
            self.get_logger().error(f'{device}: {message}')

    def _verdict(
        self, interval: acquisition_status.Interval, rises: dict[str, int]
    ) -> tuple[Level, str]:
        port = self._port
        if self._refusal or self._control.refusal:
            return Level.ERROR, self._refusal or self._control.refusal
        if port is None:
            return Level.WARN, 'looking for the control unit'
        if port.state is not PortState.RECEIVING:
            reason = f': {port.reason}' if port.reason else ''
            words = [f'{port.state.value}{reason}', self._faults.words]
            is_new = time.monotonic() - self.started_s < START_S and not port.counters.opens
            level = Level.WARN if is_new else Level.ERROR
            return level, '; '.join(filter(None, words))
        frames = interval.frames
        if interval.repeats == frames and max(frames, rises.get('duplicate_blocks', 0)) > 0:
            return Level.ERROR, 'the control unit keeps sending the same samples'
        slow = too_slow(rises.get('windows_skipped', 0), frames)
        if slow:
            self.warn('seconds_too_slow', slow)
        own = acquisition_status.device_words(self._device) if self._device is not None else ''
        # Causes stand before the counters of what was lost, as long lines are cut.
        said = (slow, f'control unit: {own}' if own else '')
        troubles = [(Level.WARN, words) for words in said if words]
        troubles += [(self._faults.level, self._faults.words)] if self._faults.words else []
        if self._stream is not None:
            coils = self._setup.emitter.coils
            troubles += acquisition_status.clock_troubles(self._stream)
            troubles += acquisition_status.signal_troubles(
                coils, self._stream, self._frame, interval
            )
        if troubles:
            return max(level for level, _ in troubles), '; '.join(words for _, words in troubles)
        if frames == 0:
            return Level.WARN, 'no windows yet'
        return Level.OK, 'streaming'

    def part_statuses(self) -> list[Status]:
        """Return the state of each emitter (amplitude, noise, current) and of each sensor."""
        stream, frame = self._stream, self._frame
        if stream is None or frame is None or len(frame.flags) != len(stream.sensors):
            return []
        return [
            *acquisition_status.emitter_statuses(self._setup.emitter.coils, stream, frame),
            *acquisition_status.sensor_statuses(stream, frame, self._last),
        ]


if __name__ == '__main__':
    sys.setswitchinterval(TURN_S)
    sys.exit(main(Acquisition))
