"""When the setup document is told anew what the stream measures of itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from anser_ros.integrity.streams import Senders
from anser_ros.nodes.acquisition_stream import MeasuredAccuracy
from anser_ros.nodes.streams.clouds import without_measured
from anser_ros.sessions.session import measured_noise, stamp_sigma
from anser_ros.settings import Accuracy
from anser_ros.wire.setup import dump_setup, parse_setup
from anser_ros.wire.text_files import read_config

SETUP = parse_setup(read_config('demo_setup.yaml'))
FRAME = SimpleNamespace(window=SimpleNamespace(sigma=np.array([7e-11, np.nan, 8.12e-11, 9e-11])))


def told(accuracy, sigmas_s, seconds, begin_s=0.0):
    """Times at which the setup is told anew, with one frame every 20 ms."""
    times = begin_s + 0.02 * np.arange(round(seconds / 0.02))
    return [t for t in times if accuracy.must_republish(FRAME, sigmas_s(t), t)]


def test_the_noise_is_told_with_the_first_frame_and_the_stamps_only_if_they_differ():
    accuracy = MeasuredAccuracy()
    assert told(accuracy, lambda t: 0.4e-3, 60.0) == [0.0]
    setup = accuracy.stated_in(SETUP, 50.0)
    assert measured_noise(setup) == 8.1e-11 and setup.flux_rate_hz == 50.0
    assert stamp_sigma(setup) == Accuracy.stamp_sigma_s and 'stamp_sigma_s' not in setup.extra


def test_stamps_that_are_worse_or_better_are_told_at_most_every_ten_seconds():
    accuracy = MeasuredAccuracy()
    times = told(accuracy, lambda t: np.inf if t < 2 else 2e-3 if t % 2 < 1 else 1.9e-3, 60.0)
    assert len(times) == 2 and 10.0 <= times[1] < 10.1
    assert stamp_sigma(accuracy.stated_in(SETUP, 50.0)) == 2e-3
    assert len(told(accuracy, lambda t: 0.2e-3, 60.0, 60.0)) == 1
    assert stamp_sigma(accuracy.stated_in(SETUP, 50.0)) == 0.2e-3
    wild = told(accuracy, lambda t: 1e-2 if t % 20 > 10 else 1e-4, 60.0, 120.0)
    assert (np.diff(wild) >= 10.0).all()


def test_a_setup_told_anew_is_still_its_sender_s_and_another_board_is_not():
    accuracy = MeasuredAccuracy()
    texts = [dump_setup(SETUP)]
    for sigma_s in (0.4e-3, 2e-3):
        assert told(accuracy, lambda t, sigma_s=sigma_s: sigma_s, 11.0, 100.0 * len(texts))
        texts.append(dump_setup(accuracy.stated_in(SETUP, 49.9)))
    assert len(set(texts)) == 3
    sources = Senders('setup', is_constant=True)
    for number, text in enumerate(texts, 1):
        assert sources.take(number, 1, 10.0 * number, without_measured(text))
    sensors = (*SETUP.sensors[:-1], replace(SETUP.sensors[-1], length_m=0.02))
    other = dump_setup(replace(SETUP, sensors=sensors))
    assert not sources.take(4, 1, 40.0, without_measured(other))
