"""The control unit's protocol: records survive the wire, and nothing else passes for a record."""

import re
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO
from hypothesis import given, settings
from hypothesis import strategies as st

from anser_ros.errors import FrameError
from anser_ros.wire import frames
from anser_ros.wire.frames import (
    Channel,
    ChannelKind,
    DeviceState,
    DeviceStatus,
    Hello,
    Identify,
    Reply,
    ReplyCode,
    SampleBlock,
    SetFrequencies,
    Start,
    StatusFlag,
    Stop,
    encode,
)
from anser_ros.wire.protocols import FrameReader

DOCS = REPO / 'docs'
TONES = tuple(6000.0 + 170 * k for k in range(8))


def hello(**changes: object) -> Hello:
    sensors = [Channel(n, ChannelKind.SENSE, 5.0) for n in range(4)]
    channels = (*sensors, Channel(48, ChannelKind.CURRENT, 4.0))
    base = Hello('anser cu 7', 40e3, 1e6, 40, channels, TONES, (0.25,) * 8)
    return replace(base, **changes)


def block(sequence: int = 3, n: int = 40, columns: int = 5) -> SampleBlock:
    codes = np.random.default_rng(sequence).integers(-32768, 32768, (n, columns)).astype('<i2')
    return SampleBlock(sequence, 1000 * sequence, codes)


STATUS = DeviceStatus(DeviceState.STREAMING, StatusFlag(0), 1_000_000, 0, 0, 25.0)
REPLY = Reply(0x84, ReplyCode.BAD_ARGUMENT, 'eight tones, not seven')
PAYLOADS = [hello(), block(), STATUS, REPLY, Identify(), Start(), Stop(), SetFrequencies(TONES)]


def same(a: object, b: object) -> bool:
    if isinstance(a, SampleBlock) and isinstance(b, SampleBlock):
        return np.array_equal(a.codes, b.codes) and (
            (a.sequence, a.timestamp_ticks, a.flags) == (b.sequence, b.timestamp_ticks, b.flags)
        )
    return a == b


@pytest.mark.parametrize('payload', PAYLOADS, ids=lambda p: type(p).__name__)
def test_record_survives_the_wire(payload):
    (record,) = FrameReader().feed(encode(payload, tag=513))
    assert record.tag == 513
    assert same(record.payload, payload)


def test_document_shows_the_bytes_that_the_code_writes():
    text = (DOCS / 'cu_protocol.md').read_text()
    shown = re.findall(r'^    (.*)$', text.split('## 5.')[1], re.MULTILINE)
    raw = bytes.fromhex(' '.join(shown))
    assert raw == encode(STATUS)


def test_records_come_whole_from_any_cut_of_the_stream():
    raw = b''.join(encode(payload) for payload in PAYLOADS)
    for step in (1, 7, 64, len(raw)):
        reader = FrameReader()
        found = [r for k in range(0, len(raw), step) for r in reader.feed(raw[k : k + step])]
        assert [type(r.payload) for r in found] == [type(p) for p in PAYLOADS]
        assert reader.counters.skipped_bytes == 0


def test_every_damaged_byte_costs_at_most_its_own_record():
    first, second, third = (encode(block(k, 3, 2)) for k in range(3))
    for position in range(len(second)):
        damaged = bytearray(second)
        damaged[position] ^= 0x5A
        reader = FrameReader()
        found = reader.feed(first + bytes(damaged) + third)
        assert [r.payload.sequence for r in found] == [0, 2]


def corrupt_inputs() -> dict[str, tuple[bytes, set[str]]]:
    """Return broken streams by name, with the counters that they raise."""
    good = encode(block())
    rng = np.random.default_rng(5)
    noise = bytes(rng.integers(0, 256, 5000, dtype=np.uint8))
    bad_crc = good[:-1] + bytes([good[-1] ^ 1])
    other_version = bytearray(good[:12])
    other_version[4] = 2
    other_version[10:12] = struct.pack('<H', frames.header_check(bytes(other_version)))
    body = bytes(other_version) + good[12:-4]
    version2 = body + struct.pack('<I', zlib.crc32(body))
    short_hello = _forge(0x01, encode(hello())[12:40])
    return {
        'noise_in_front': (noise, {'skipped_bytes'}),
        'magic_only': (frames.MAGIC * 50, {'bad_header'}),
        'cut_record': (good[:37], {'bad_crc', 'skipped_bytes'}),
        'bad_crc': (bad_crc, {'bad_crc'}),
        'bad_header': (good[:6] + b'\xff\xff' + good[8:], {'bad_header'}),
        'version_2': (version2, {'wrong_version'}),
        'unknown_type': (_forge(0x7E, b'future'), {'unknown_type'}),
        'short_hello': (short_hello, {'bad_payload'}),
        'samples_of_wrong_size': (_forge(0x02, good[12:-8]), {'bad_payload'}),
        'text_not_utf8': (_forge(0x04, b'\x82\x00\xff\xfe'), {'bad_payload'}),
        'reply_code_unknown': (_forge(0x04, b'\x82\x63'), {'bad_payload'}),
        'tone_nan': (_forge(0x84, struct.pack('<d', float('nan'))), {'bad_payload'}),
        'tone_cut': (_forge(0x84, b'1234567'), {'bad_payload'}),
        'ascii_device': (b'$GPGGA,123519,4807.038,N*47\r\n' * 40, {'skipped_bytes'}),
    }


def _forge(number: int, body: bytes) -> bytes:
    head = frames.HEADER.pack(frames.MAGIC, 1, number, len(body), 0, 0)
    raw = head[:10] + struct.pack('<H', frames.header_check(head)) + body
    return raw + struct.pack('<I', zlib.crc32(raw))


def test_corrupt_inputs_are_named_and_the_good_record_behind_is_found():
    for name, (raw, expected) in corrupt_inputs().items():
        reader = FrameReader()
        found = reader.feed(raw + encode(block()))
        assert len(found) == 1 and same(found[0].payload, block()), name
        counted = {key for key, value in reader.fault_counters().items() if value}
        assert expected <= counted, (name, counted)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=600), st.integers(0, 7), st.lists(st.integers(1, 50), max_size=20))
def test_garbage_never_breaks_the_reader_nor_hides_the_next_record(garbage, which, cuts):
    reader = FrameReader(max_payload=4096)
    good = encode(PAYLOADS[which], tag=9)
    raw = garbage + good
    found, start = [], 0
    for cut in [*cuts, len(raw)]:
        found += reader.feed(raw[start : start + cut])
        start += cut
    found += reader.feed(raw[start:] + bytes(5000))
    assert any(r.tag == 9 and same(r.payload, PAYLOADS[which]) for r in found)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(frames.TYPE_OF.values())), st.binary(max_size=300))
def test_hostile_payloads_are_refused_or_decoded_never_a_crash(number, body):
    reader = FrameReader()
    records = reader.feed(_forge(number, body))
    assert len(records) + reader.counters.bad_payload == 1
    for record in records:
        if isinstance(record.payload, Hello):
            frames.check_hello(record.payload)


@pytest.mark.parametrize(
    'change',
    [
        {'sample_rate_hz': 0.0},
        {'tick_hz': float('inf')},
        {'tick_hz': 1e-300},
        {'sample_rate_hz': 1e9},
        {'channels': tuple(Channel(n, ChannelKind.CURRENT, 1.0) for n in range(2000))},
        {'block_samples': 0},
        {'block_samples': 65535},
        {'frequencies_hz': (), 'currents_a': ()},
        {'frequencies_hz': (20e3,) * 8},
        {'channels': ()},
        {'channels': (Channel(1, ChannelKind.CURRENT, 1.0),) * 2},
        {'channels': (Channel(1, ChannelKind.CURRENT, float('nan')),)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_hello_that_nobody_can_use_is_refused(change):
    with pytest.raises(FrameError):
        frames.check_hello(hello(**change))
    reader = FrameReader()
    assert reader.feed(encode(hello(**change))) == []
    assert reader.counters.bad_payload == 1


def test_newer_minor_version_with_more_bytes_is_understood():
    raw = encode(hello(minor=3))
    (record,) = FrameReader().feed(_forge(0x01, raw[12:-4] + b'from the future'))
    assert record.payload == hello(minor=3)


def test_payload_too_long_for_a_record():
    with pytest.raises(FrameError, match='does not fit'):
        encode(block(0, 1000, 40))


def test_forged_length_holds_nothing_back_once_the_block_size_is_known():
    reader = FrameReader(max_payload=4096)
    forged = _forge(0x02, bytes(60000))[:2000]
    found = reader.feed(forged + encode(STATUS))
    assert [r.payload for r in found] == [STATUS]
    assert reader.counters.bad_header == 1
