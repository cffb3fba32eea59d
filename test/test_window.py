"""Blocks to windows: what was lost, saturated or stuck is flagged, whatever the sequence."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anser_ros.errors import ParameterError
from anser_ros.signals.repetition import RepetitionWatch
from anser_ros.signals.window import TickCheck, WindowCutter


def cutter_of(window, hop, columns):
    """A cutter for 40 kS/s and ticks of a microsecond."""
    return WindowCutter(window, hop, RepetitionWatch(columns, 40e3), TickCheck(40e3, 1e6))


class TestWindows:
    def stream(self, blocks: int, columns: int = 2) -> np.ndarray:
        return np.random.default_rng(0).integers(-99, 99, (40 * blocks, columns)).astype('i2')

    def feed(self, cutter, samples, skip=(), start=0):
        windows = []
        for k in range(len(samples) // 40):
            if k not in skip:
                part = samples[40 * k : 40 * k + 40]
                windows += cutter.push((start + k) % 2**32, 1000 * k, part)
        return windows

    @pytest.mark.parametrize(
        ('window', 'hop'), [(200, 200), (800, 200), (333, 7), (2000, 801), (200, 500)]
    )
    def test_every_window_is_the_right_part_of_the_stream(self, window, hop):
        samples = self.stream(400)
        cutter = cutter_of(window, hop, 2)
        windows = self.feed(cutter, samples)
        assert len(windows) == (len(samples) - window) // hop + 1
        for k, one in enumerate(windows):
            assert np.array_equal(one.codes, samples[k * hop : k * hop + window])
            assert not one.dropped and one.present.all()
            assert one.middle_sample == k * hop + window / 2

    def test_sequence_wraps_around(self):
        windows = self.feed(cutter_of(200, 200, 2), self.stream(20), start=2**32 - 7)
        assert len(windows) == 4 and not any(w.dropped for w in windows)

    def test_a_hole_keeps_the_grid_and_is_flagged(self):
        samples = self.stream(100)
        cutter = cutter_of(400, 400, 2)
        windows = self.feed(cutter, samples, skip={14, 15, 25})
        assert [w.dropped for w in windows] == [False, True, True] + [False] * 7
        for k, one in enumerate(windows):
            expected = samples[400 * k : 400 * k + 400]
            assert np.array_equal(one.codes[one.present], expected[one.present])
            assert one.middle_sample == 400 * k + 200
        assert (~windows[1].present).sum() == 80
        assert cutter.counters.missing_samples == 120
        assert cutter.counters.windows_dropped_samples == 2

    @pytest.mark.parametrize('hole', [8, 30, 61, 95])
    def test_a_long_hole_loses_windows_and_the_grid_stays(self, hole):
        samples = self.stream(120)
        cutter = cutter_of(400, 200, 2)
        windows = self.feed(cutter, samples, skip=set(range(11, 11 + hole)))
        assert len(windows) + cutter.counters.windows_lost == (len(samples) - 400) // 200 + 1
        last = windows[-1]
        assert np.array_equal(last.codes[last.present], samples[-400:][last.present])
        assert last.middle_sample == len(samples) - 200

    def test_duplicates_are_dropped_and_a_restart_begins_anew(self):
        samples = self.stream(12)
        cutter = cutter_of(200, 200, 2)
        cutter.push(0, 0, samples[:40])
        cutter.push(1, 1000, samples[40:80])
        assert cutter.push(1, 1000, samples[40:80]) == []
        assert cutter.counters.duplicate_blocks == 1
        windows, samples = [], self.stream(12) + 1
        for k in range(5):
            part = samples[40 * k : 40 * k + 40]
            windows += cutter.push(k, 9000 + 1000 * k, part)
        assert cutter.counters.restarts == 1
        assert np.array_equal(windows[0].codes, samples[:200])

    @pytest.mark.parametrize('sequence', [3, 70])
    def test_a_restart_whose_begin_was_lost_is_no_hole(self, sequence):
        """A hole of the wrong length would join pieces whose phases do not fit."""
        samples = self.stream(30)
        cutter = cutter_of(400, 400, 2)
        self.feed(cutter, samples[:920])
        windows = []
        for k in range(10):
            part = samples[40 * k : 40 * k + 40]
            windows += cutter.push(sequence + k, 500_000 + 1000 * k, part)
        assert cutter.counters.restarts == 1 and cutter.counters.missing_samples == 0
        (window,) = windows
        assert np.array_equal(window.codes, samples[:400]) and not window.dropped

    @settings(max_examples=100, deadline=None)
    @given(
        st.lists(
            st.tuples(
                st.one_of(st.integers(0, 30), st.integers(0, 2**32 - 1)),
                st.one_of(st.integers(0, 30_000), st.integers(0, 2**64 - 1)),
                st.integers(1, 60),
            ),
            max_size=40,
        )
    )
    def test_no_order_of_blocks_breaks_it(self, blocks):
        cutter = cutter_of(200, 77, 2)
        for sequence, ticks, samples in blocks:
            for window in cutter.push(sequence, ticks, np.ones((samples, 2), np.int16)):
                assert window.codes.shape == (200, 2)
                assert 2 * window.present.sum() >= 200

    def test_saturated_and_stuck_channels(self):
        samples = self.stream(5, 4)
        samples[17, 1] = 32767
        samples[90, 2] = -32768
        samples[:, 3] = 5
        (window,) = self.feed(cutter_of(200, 200, 4), samples)
        assert window.saturated.tolist() == [False, True, True, False]
        assert window.stuck.tolist() == [False, False, False, True]

    def test_refusals(self):
        with pytest.raises(ParameterError, match='hop of 0'):
            cutter_of(200, 0, 2)
        with pytest.raises(ParameterError, match='block of 3 channels'):
            cutter_of(200, 200, 2).push(0, 0, np.zeros((40, 3), np.int16))


def run(ticks_of, blocks=1000, check=None):
    check = check or TickCheck(40e3, 1e6)
    for k in range(blocks):
        check.take(40 * k, int(ticks_of(k)))
    return check


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-200, 200), st.sampled_from([2**32, 2**64]))
def test_a_counter_that_wraps_or_drifts_a_little_is_believed(begin, ppm, wrap):
    check = run(lambda k: (begin + 1000 * k * (1 + 1e-6 * ppm)) % wrap, 3000)
    assert check.trusted and not check.words and check.disagreements == 0


@pytest.mark.parametrize('rate', [0.5, 0.99, 1.01, 2.0, 1000.0])
def test_a_wrong_pace_is_said_within_a_tenth_of_a_second(rate):
    check = run(lambda k: 1000 * k * rate, 100)
    assert not check.trusted and check.words == f'run at {rate:.4g} times the pace of the samples'
    assert check.disagreements == 1


def test_a_counter_that_stands_still():
    assert run(lambda k: 5, 10).words == 'stand still'


def test_a_jump_is_said_and_forgotten_after_a_while():
    check = run(lambda k: 1000 * k + 1_200_000 * (k >= 900))
    assert check.words == 'jumped by 1.2 s' and check.disagreements == 1
    for k in range(1000, 1300):
        check.take(40 * k, 1000 * k + 1_200_000)
    assert check.trusted and not check.words


def test_ticks_confirm_holes_while_they_are_believed():
    check = run(lambda k: 1000 * k, 100)
    assert check.confirms(400, 109_000) and not check.confirms(400, 150_000)
    check = run(lambda k: 7, 100)
    assert check.confirms(400, 7) and not check.confirms(40_000 * 11, 7)
    check.take_after_hole(5000, 7)
    check.reset()
    assert check.trusted and not check.words
