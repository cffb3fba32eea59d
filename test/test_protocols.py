"""Another control unit's protocol: bytes of its own, the same records, nothing else changed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_port import HELLO, TONES, Wire, receive, wait

from anser_ros.nodes.acquisition import AcquisitionParameters
from anser_ros.wire.frames import (
    TYPE_OF,
    Identify,
    Record,
    Reply,
    ReplyCode,
    SampleBlock,
    SetFrequencies,
    Start,
)
from anser_ros.wire.port import ControlUnitPort, PortState
from anser_ros.wire.protocols import PROTOCOLS, SerialProtocol

VERBS = {Identify: 'who', Start: 'go'}
"""The commands that the toy unit has; its tones are fixed."""


class LineReader:
    """One JSON list a line: ['hello'], ['data', number, codes] or ['done', verb, tag]."""

    def __init__(self):
        self.last_refusal = ''
        self._pending, self._bad_lines = b'', 0

    def reset(self):
        self._pending = b''

    def fault_counters(self):
        return {'bad_lines': self._bad_lines}

    def feed(self, data):
        *lines, self._pending = (self._pending + data).split(b'\n')
        return [record for record in map(self._record, lines) if record is not None]

    def _record(self, line):
        try:
            kind, *rest = json.loads(line)
        except ValueError:
            self._bad_lines += 1
            self.last_refusal = 'a line that is no JSON'
            return None
        if kind == 'hello':
            return Record(HELLO, 0)
        if kind == 'data':
            return Record(SampleBlock(rest[0], 40 * rest[0], np.array(rest[1], np.int16)), 0)
        (command,) = (command for command, verb in VERBS.items() if verb == rest[0])
        return Record(Reply(TYPE_OF[command], ReplyCode.OK), rest[1])


def encode_line(command, tag):
    verb = VERBS.get(type(command))
    return b'' if verb is None else f'{verb} {tag}\n'.encode()


TOY = SerialProtocol(LineReader, encode_line)


def line(*parts):
    return json.dumps(parts).encode() + b'\n'


@pytest.fixture
def wire(tmp_path):
    cable = Wire(tmp_path / 'cu')
    yield cable
    cable.unplug()


@pytest.fixture
def port(wire):
    reader = ControlUnitPort(str(wire.link), protocol=TOY, silence_s=0.5)
    reader.start()
    assert wait(lambda: reader.state is PortState.WAITING)
    yield reader
    reader.stop()


def test_a_port_speaks_another_protocol(wire, port):
    codes = np.arange(80).reshape(40, 2)
    wire.write(b'noise\n' + line('hello') + line('data', 0, codes.tolist()))
    hello, block = receive(port, 2)
    assert hello == HELLO
    assert np.array_equal(block.codes, codes)
    wire.write(line('data', 3, codes.tolist()))
    assert receive(port, 1)[0].sequence == 3
    counters = port.fault_counters()
    assert (counters['gap_blocks'], counters['bad_lines']) == (2, 1)
    assert port.last_refusal == 'a line that is no JSON'
    assert port.send(SetFrequencies(TONES)) == 1  # which the unit does not have
    tag = port.send(Start())
    assert wire.read() == f'go {tag}\n'.encode()


def test_a_reader_that_fails_closes_the_port_and_it_is_opened_again(wire, port, monkeypatch):
    wire.write(line('done', 'a verb that no command has', 1))
    assert wait(lambda: port.counters.reader_failures == 1)
    assert wait(lambda: port.state is PortState.WAITING and port.counters.opens == 2)
    monkeypatch.setattr('test_protocols.HELLO', replace(HELLO, channels=HELLO.channels[:1]))
    wire.write(line('hello'))
    assert wait(lambda: port.counters.reader_failures == 2)
    assert wait(lambda: port.counters.opens == 3)
    monkeypatch.undo()
    wire.write(line('hello'))
    assert receive(port, 1) == [HELLO]


def test_the_acquisition_knows_every_protocol():
    assert PROTOCOLS['anser'].sets_tones and not TOY.sets_tones
    rule = AcquisitionParameters.__dataclass_fields__['protocol'].metadata['rule']
    assert set(rule.choices) == set(PROTOCOLS)
    assert AcquisitionParameters().protocol in PROTOCOLS
