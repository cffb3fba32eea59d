"""Faults of the line in words, for as long as an operator needs to read them."""

from anser_ros.nodes.acquisition_status import MEMORY_S, RecentFaults, device_words
from anser_ros.nodes.runtime.diagnostics import Level
from anser_ros.wire.frames import DeviceState, DeviceStatus, StatusFlag


def test_a_fault_is_told_with_its_count_and_forgotten_in_time():
    faults = RecentFaults()
    faults.note({'bad_crc': 7, 'gap_blocks': 0}, 0.0)
    assert faults.words == ''
    faults.note({'bad_crc': 8, 'gap_blocks': 0}, 1.0)
    assert faults.words == 'bad_crc 1 (records with a wrong CRC)'
    assert faults.level is Level.WARN
    faults.note({'bad_crc': 8, 'gap_blocks': 0}, 1.0 + MEMORY_S)
    assert faults.words == ''


def test_what_stops_the_stream_is_an_error_and_comes_first():
    faults = RecentFaults()
    faults.note({'wrong_baud': 0, 'skipped_bytes': 0}, 0.0)
    faults.note({'wrong_baud': 1, 'skipped_bytes': 900}, 1.0)
    assert faults.words.startswith('wrong_baud 1 (bytes but no records: wrong baud rate?)')
    assert faults.level is Level.ERROR


def test_the_device_complains_in_words():
    flags = StatusFlag.OVERRUN | StatusFlag.COIL_OPEN
    assert device_words(DeviceStatus(DeviceState.STREAMING, flags, 0, 12, 0, 30.0)) == (
        'coil open, overrun, 12 blocks dropped (computer or line too slow)'
    )
