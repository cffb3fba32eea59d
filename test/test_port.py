"""The port over real pseudo-terminals: every fault is survived, counted and named."""

import contextlib
import os
import threading
import time
import tty
from dataclasses import replace

import numpy as np
import pytest
from conftest import PATIENCE_S, wait

from anser_ros.errors import PortError
from anser_ros.wire.frames import (
    Channel,
    ChannelKind,
    Hello,
    Identify,
    Record,
    Reply,
    ReplyCode,
    SampleBlock,
    SetFrequencies,
    Start,
    encode,
)
from anser_ros.wire.port import ControlUnitPort, PortState, find_port
from anser_ros.wire.protocols import FrameReader, StreamControl

TONES = (6000.0, 6170.0)
CHANNELS = (Channel(0, ChannelKind.SENSE, 5.0), Channel(1, ChannelKind.CURRENT, 1.0))
HELLO = Hello('test unit', 40e3, 1e6, 40, CHANNELS, TONES, (0.25, 0.25))


def block(sequence: int) -> bytes:
    return encode(SampleBlock(sequence, sequence, np.full((40, 2), 7, np.int16)))


class Wire:
    """The far end of a cable: a pseudo-terminal behind a link that keeps its name."""

    def __init__(self, link):
        self.link = link
        self.fds = ()
        self.plug()

    def plug(self):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.fds = (self.master, slave)
        with contextlib.suppress(FileNotFoundError):
            self.link.unlink()
        self.link.symlink_to(os.ttyname(slave))

    def unplug(self):
        for fd in self.fds:
            os.close(fd)
        self.fds = ()
        self.link.unlink()

    def write(self, data: bytes):
        def is_written():
            nonlocal data
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(self.master, data) :]
            return not data

        assert wait(is_written)

    def read(self, seconds: float = PATIENCE_S) -> bytes:
        got = []

        def is_read():
            with contextlib.suppress(BlockingIOError):
                got.append(os.read(self.master, 4096))
            return got

        return got[0] if wait(is_read, timeout_s=seconds) else b''


@pytest.fixture
def wire(tmp_path):
    cable = Wire(tmp_path / 'cu')
    yield cable
    if cable.fds:
        cable.unplug()


@contextlib.contextmanager
def started(device, **options):
    """A port while its reader runs."""
    reader = ControlUnitPort(str(device), **options)
    reader.start()
    try:
        yield reader
    finally:
        reader.stop()


@pytest.fixture
def port(wire, request):
    """A port that is open; it finds no silence within a test, unless one says after how long."""
    silence_s = getattr(request, 'param', 600.0)
    options = {'silence_s': silence_s, 'pause_s': 0.02, 'longest_pause_s': 0.1}
    with started(wire.link, **options) as reader:
        assert wait(lambda: reader.state is PortState.WAITING)
        yield reader
    assert reader.state is PortState.CLOSED


def receive(port, count: int) -> list:
    payloads = []

    def take():
        batch = port.get(0.1)
        payloads.extend(record.payload for record in (batch.records if batch else ()))

    wait(lambda: len(payloads) >= count, take)
    return payloads


def write_singly(wire, port, count: int):
    """Write blocks, each after the one before was read."""
    for sequence in range(count):
        wire.write(block(sequence))
        assert wait(lambda n=sequence: port.fault_counters()['records'] == n + 1)


def test_records_arrive_in_order(wire, port):
    wire.write(encode(HELLO) + b''.join(block(k) for k in range(20)))
    payloads = receive(port, 21)
    assert payloads[0] == HELLO
    assert [p.sequence for p in payloads[1:]] == list(range(20))
    assert port.state is PortState.RECEIVING
    assert port.fault_counters()['gap_blocks'] == 0


def test_commands_reach_the_wire_with_their_tag(wire, port):
    begin = time.monotonic_ns()
    tag = port.send(SetFrequencies(TONES))
    (record,) = FrameReader().feed(wire.read())
    assert record == Record(SetFrequencies(TONES), tag)
    assert begin < port.sent_ns(tag) < time.monotonic_ns()
    assert port.sent_ns(tag + 1) is None


def test_a_unit_that_takes_no_command_is_not_called_unplugged(wire, port):
    while not port.counters.unwritten:
        for _ in range(20):
            port.send(SetFrequencies(TONES))
        time.sleep(0.01)
    wire.write(encode(HELLO))
    assert receive(port, 1) == [HELLO]
    assert port.counters.unplug == 0 and port.counters.opens == 1


@pytest.mark.parametrize(
    ('device', 'why'),
    [
        ('/dev/no_such_port', 'No such file or directory'),
        (__file__, 'it is not a serial port'),
        ('nothing://here', "invalid URL, protocol 'nothing' not known"),
        ('loop://?unknown=1', "unknown option: 'unknown'"),
    ],
)
def test_why_a_port_does_not_open_is_one_short_line(device, why):
    with started(device) as port:
        assert wait(lambda: port.counters.open_failures > 0)
        assert port.reason == f'cannot open {device}: {why}'


def test_a_port_is_opened_and_started_once(wire, port):
    assert wait(lambda: port.counters.opens == 1)
    with pytest.raises(PortError, match='started before'):
        port.start()
    with started(port.device) as other:
        assert wait(lambda: other.counters.open_failures > 0)
        assert other.reason == f'cannot open {port.device}: another program uses it'


def test_unplugged_cable_is_counted_and_the_port_comes_back(wire, port):
    wire.write(encode(HELLO))
    assert receive(port, 1) == [HELLO]
    wire.unplug()
    ended = []
    assert wait(lambda: ended.append(port.get(0.1)) or (ended[-1] and not ended[-1].records)), (
        'whoever receives gets an empty batch'
    )
    assert wait(lambda: port.state is PortState.ABSENT)
    assert port.counters.unplug == 1
    assert wait(lambda: port.counters.open_failures > 1)
    assert port.reason == f'cannot open {port.device}: No such file or directory'
    wire.plug()
    assert wait(lambda: port.counters.opens == 2)
    wire.write(encode(HELLO))
    assert receive(port, 1) == [HELLO]
    assert port.state is PortState.RECEIVING


def test_gap_in_the_sequence_is_counted_in_blocks(wire, port):
    wire.write(block(4) + block(5) + block(9))
    assert len(receive(port, 3)) == 3
    assert port.counters.gap_blocks == 3
    wire.write(block(0) + block(1))
    assert len(receive(port, 2)) == 2
    assert port.counters.gap_blocks == 3, 'a restarted stream is no gap'


def test_bytes_without_records_are_called_a_wrong_baud_rate(wire, port):
    rng = np.random.default_rng(1)

    def babble():
        wire.write(bytes(rng.integers(0, 256, 500, dtype=np.uint8)))
        time.sleep(0.05)

    assert wait(lambda: port.counters.wrong_baud, babble)
    assert port.state is PortState.WRONG_BAUD
    assert 'baud' in port.state.value


@pytest.mark.parametrize('port', [0.5], indirect=True)
def test_silence_is_counted_and_ends_with_the_next_record(wire, port):
    wire.write(encode(HELLO))
    assert wait(lambda: port.counters.silence)
    assert port.state is PortState.SILENT
    wire.write(encode(HELLO))
    assert wait(lambda: port.state is PortState.RECEIVING)


def test_slow_receiver_loses_blocks_but_no_hello_and_stops_nobody(wire):
    with started(wire.link, queue_blocks=3) as port:
        assert wait(lambda: port.state is PortState.WAITING)
        write_singly(wire, port, 30)
        wire.write(encode(HELLO))
        assert wait(lambda: port.fault_counters()['records'] == 31)
        assert port.counters.overrun_blocks >= 26
        batches = iter(lambda: port.get(0.05), None)
        assert HELLO in [record.payload for batch in batches for record in batch.records]


def test_receiver_is_woken_for_as_many_blocks_as_it_wants(wire, port):
    port.blocks_wanted = 5
    write_singly(wire, port, 12)
    assert len(receive(port, 12)) == 12, 'a pause hands over what there is'
    wire.write(block(12) + encode(HELLO))
    assert len(receive(port, 2)) == 2, 'a hello waits for nothing'


def test_the_right_port_is_found_by_listening_only(wire, tmp_path):
    other = Wire(tmp_path / 'gps')
    try:
        other.write(b'$GPGGA,123519,4807.038,N*47\r\n')
        wire.write(encode(HELLO))
        # pyserial empties the buffer when it opens a port, so the hello must come again
        found = []

        def search():
            found.append(find_port([str(other.link), str(wire.link)], listen_s=0.5))

        thread = threading.Thread(target=search)
        thread.start()
        while thread.is_alive():
            wire.write(encode(HELLO))
            time.sleep(0.05)
        assert found == [str(wire.link)]
        assert wire.read(0.05) == b'' and other.read(0.05) == b''
    finally:
        other.unplug()


def test_no_port_speaks(wire, tmp_path):
    with pytest.raises(PortError, match='on any of 2'):
        find_port([str(wire.link), str(tmp_path / 'absent')], listen_s=0.1)


SECOND = 1_000_000_000


def test_control_asks_for_hello_then_tones_then_samples():
    control = StreamControl((6000.0, 6200.0))
    now = SECOND
    assert control.due(now) == Identify()
    assert control.due(now + SECOND // 10) is None, 'not repeated at once'
    assert control.due(now + SECOND) == Identify()
    control.take(Record(HELLO), now)
    assert not control.tones_agree
    assert control.due(now) == SetFrequencies((6000.0, 6200.0))
    right = replace(HELLO, frequencies_hz=(6000.0, 6199.99))
    control.take(Record(right), now)
    assert control.tones_agree
    assert control.due(now) == Start()
    assert not control.started
    control.take(Record(Reply(0x82, ReplyCode.OK)), now)
    assert control.started
    control.take(Record(SampleBlock(0, 0, np.zeros((1, 2), np.int16))), now)
    assert control.due(now + SECOND // 4) is None
    assert control.due(now + 2 * SECOND) == Start(), 'a stream that stopped is started again'
    control.reset()
    assert control.due(now + 3 * SECOND) == Identify()


def test_control_keeps_a_refusal_and_says_what_differs():
    for may_set, asked, words in (
        (True, SetFrequencies((6000.0,)), ['two coils']),
        (False, None, ['6170', '6000']),
    ):
        control = StreamControl((6000.0,), set_frequencies=may_set)
        control.take(Record(HELLO), 0)
        assert control.due(SECOND) == asked
        if may_set:
            control.take(Record(Reply(0x84, ReplyCode.BAD_ARGUMENT, 'two coils')), SECOND)
        assert all(word in control.refusal for word in words)
        assert control.due(3 * SECOND) is None, 'it does not insist'


def test_control_asks_again_after_a_hello_that_contradicts_a_good_one():
    control = StreamControl(HELLO.frequencies_hz)
    other = replace(HELLO, channels=HELLO.channels[::-1])
    control.take(Record(HELLO), 0)
    control.take(Record(Reply(0x82, ReplyCode.OK)), 0)

    def asked(hello, begin_ns, seconds):
        """Return the commands of some seconds in which blocks come."""
        control.take(Record(hello), begin_ns)
        out = []
        for now in range(begin_ns, begin_ns + seconds * SECOND, SECOND // 20):
            control.take(Record(SampleBlock(0, 0, np.zeros((1, 2), np.int16))), now)
            out += [command] if (command := control.due(now)) is not None else []
        return out

    assert asked(HELLO, 0, 3) == [], 'the same again'
    assert asked(other, 3 * SECOND, 2) == [Identify()] * 8, 'four a second'
    assert len(asked(HELLO, 5 * SECOND, 100)) == 4 * 60, 'a minute after the last change'


def test_bytes_gather_only_while_no_window_is_due(monkeypatch):
    """The last block of a window is waited for at the line, however many are wanted."""
    rests = []
    monkeypatch.setattr(time, 'sleep', rests.append)
    port = ControlUnitPort('nowhere')
    record = Record(SampleBlock(0, 0, np.zeros((1, 2), np.int16)))
    port.want(20)
    port._take([record], 0)
    port._rest(time.monotonic_ns())
    assert sum(rests) == 0, 'the length of a block is not known'
    port.want(20, 1e-3)
    for held, rest_s in ((17, 2e-3), (18, 1e-3), (19, 0.0), (20, 0.0)):
        rests.clear()
        port._take([record] * (held - port._held_blocks), 0)
        port._rest(time.monotonic_ns())
        assert sum(rests) == pytest.approx(rest_s, abs=5e-4), held
    port._take([record], 0)
    port._rest(time.monotonic_ns())
    assert rests[-1] == pytest.approx(3e-3, abs=5e-4), 'arrivals stay punctual'
    port._take([Record(SampleBlock(0, 0, np.zeros((3000, 2), np.int16)))], 0)
    port._rest(time.monotonic_ns())
    assert rests[-1] == pytest.approx(1e-3, abs=5e-4), 'the line holds no more bytes'


def test_blocks_that_are_there_already_are_not_waited_for():
    """A receiver that worked while the last block of its window came gets it at once."""
    port = ControlUnitPort('nowhere')
    port.want(20)
    port._take([Record(SampleBlock(k, k, np.zeros((1, 2), np.int16))) for k in range(5)], 7)
    assert port.get(0.0) is None
    port.want(6)
    assert port.get(0.0) is None
    port.want(5)
    batch = port.get(0.0)
    assert batch is not None and len(batch.records) == 5
    assert port.get(0.0) is None
