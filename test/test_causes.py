"""What an operator is told: why poses fail, faults for long enough, and how good a stream is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from anser_ros.integrity.streams import Senders
from anser_ros.nodes.acquisition_status import MEMORY_S, RecentFaults, device_words
from anser_ros.nodes.acquisition_stream import MeasuredAccuracy
from anser_ros.nodes.operator_words import MOST_CAUSES, MOST_TEXT, LastStatus, causes
from anser_ros.nodes.runtime.diagnostics import Level
from anser_ros.nodes.streams.clouds import without_measured
from anser_ros.sessions.session import measured_noise, stamp_sigma
from anser_ros.settings import Accuracy
from anser_ros.wire.frames import DeviceState, DeviceStatus, StatusFlag
from anser_ros.wire.setup import dump_setup, parse_setup
from anser_ros.wire.text_files import read_config


def told(**changes):
    quiet = {
        'anser/acquisition': LastStatus(0, 'streaming', {'rate_hz': '50'}),
        'anser/tracker': LastStatus(0, 'tracking', {}),
        'anser/tracker: tool_a/0/x': LastStatus(0, 'ok', {}),
        'other/tracker: tool_a/0/x': LastStatus(2, 'stale: no flux', {}),
    }
    return {**quiet, **{name.replace('__', '/'): value for name, value in changes.items()}}


def test_nothing_is_said_of_what_is_well_and_a_slow_computer_is():
    assert causes(told(), 'anser', 50.0) == []
    words = 'overrun_blocks 120 (blocks lost: this computer is too slow)'
    slow = told(anser__acquisition=LastStatus(1, words, {'rate_hz': '30'}))
    assert causes(slow, 'anser', 50.0) == [f'acquisition: {words}; 40% of the frames are missing']
    assert causes(slow, 'anser') == [f'acquisition: {words}']
    slow['anser/acquisition'] = LastStatus(1, words, {'rate_hz': '49'})
    assert causes(slow, 'anser', 50.0) == [f'acquisition: {words}']


def test_sensors_of_one_reason_stand_together_behind_the_nodes():
    stale = 'references_lost: no reference fluxes for 1.2 s'
    found = told(
        anser__field_model=LastStatus(2, stale, {}), anser__tracker=LastStatus(1, 'no poses', {})
    )
    for n in range(5):
        found[f'anser/tracker: tool_a/{n}'] = LastStatus(1, 'references_lost', {})
    assert causes(found, 'anser') == [
        f'field_model: {stale}',
        'tracker: no poses',
        'references_lost (tool_a/0, tool_a/1, tool_a/2 and 2 more)',
    ]


def test_a_flood_has_an_end():
    flood = {f'anser/node{n}': LastStatus(1, 500 * 'x', {}) for n in range(30)}
    texts = causes(flood, 'anser')
    assert len(texts) == MOST_CAUSES and max(map(len, texts)) == MOST_TEXT


def test_a_fault_is_told_and_forgotten_in_time_and_what_stops_the_stream_comes_first():
    faults = RecentFaults()
    faults.note({'bad_crc': 7, 'gap_blocks': 0}, 0.0)
    assert faults.words == ''
    faults.note({'bad_crc': 8, 'gap_blocks': 0}, 1.0)
    assert faults.words == 'bad_crc 1 (records with a wrong CRC)'
    assert faults.level is Level.WARN
    faults.note({'bad_crc': 8, 'gap_blocks': 0}, 1.0 + MEMORY_S)
    assert faults.words == ''
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


SETUP = parse_setup(read_config('demo_setup.yaml'))
FRAME = SimpleNamespace(window=SimpleNamespace(sigma=np.array([7e-11, np.nan, 8.12e-11, 9e-11])))


def times_of(accuracy, sigmas_s, seconds, begin_s=0.0):
    """Times at which the setup is times_of anew, with one frame every 20 ms."""
    times = begin_s + 0.02 * np.arange(round(seconds / 0.02))
    return [t for t in times if accuracy.must_republish(FRAME, sigmas_s(t), t)]


def test_the_noise_is_told_with_the_first_frame_and_the_stamps_only_if_they_differ():
    accuracy = MeasuredAccuracy()
    assert times_of(accuracy, lambda t: 0.4e-3, 60.0) == [0.0]
    setup = accuracy.stated_in(SETUP, 50.0)
    assert measured_noise(setup) == 8.1e-11 and setup.flux_rate_hz == 50.0
    assert stamp_sigma(setup) == Accuracy.stamp_sigma_s and 'stamp_sigma_s' not in setup.extra


def test_stamps_that_are_worse_or_better_are_told_at_most_every_ten_seconds():
    accuracy = MeasuredAccuracy()
    times = times_of(accuracy, lambda t: np.inf if t < 2 else 2e-3 if t % 2 < 1 else 1.9e-3, 60.0)
    assert len(times) == 2 and 10.0 <= times[1] < 10.1
    assert stamp_sigma(accuracy.stated_in(SETUP, 50.0)) == 2e-3
    assert len(times_of(accuracy, lambda t: 0.2e-3, 60.0, 60.0)) == 1
    assert stamp_sigma(accuracy.stated_in(SETUP, 50.0)) == 0.2e-3
    wild = times_of(accuracy, lambda t: 1e-2 if t % 20 > 10 else 1e-4, 60.0, 120.0)
    assert (np.diff(wild) >= 10.0).all()


def test_a_setup_told_anew_is_still_its_sender_s_and_another_board_is_not():
    accuracy = MeasuredAccuracy()
    texts = [dump_setup(SETUP)]
    for sigma_s in (0.4e-3, 2e-3):
        assert times_of(accuracy, lambda t, sigma_s=sigma_s: sigma_s, 11.0, 100.0 * len(texts))
        texts.append(dump_setup(accuracy.stated_in(SETUP, 49.9)))
    assert len(set(texts)) == 3
    sources = Senders('setup', is_constant=True)
    for number, text in enumerate(texts, 1):
        assert sources.take(number, 1, 10.0 * number, without_measured(text))
    sensors = (*SETUP.sensors[:-1], replace(SETUP.sensors[-1], length_m=0.02))
    other = dump_setup(replace(SETUP, sensors=sensors))
    assert not sources.take(4, 1, 40.0, without_measured(other))
