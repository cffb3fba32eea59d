"""Blocks to windows: what was lost, saturated, stuck or said before is flagged."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anser_ros.errors import ParameterError
from anser_ros.signals.repetition import EVIDENCE_BITS, RepetitionWatch
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


def test_a_counter_that_stands_still_is_said_and_a_jump_forgotten_after_a_while():
    assert run(lambda k: 5, 10).words == 'stand still'
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
    check.begin(5000, 7)
    check.reset()
    assert check.trusted and not check.words


RATE_HZ = 40e3
TONES = np.array([6000.0, 6170.0, 6340.0, 6510.0, 6690.0, 6860.0, 7030.0, 7200.0])
"""They all return after 0.1 s: samples that lie so far apart differ by their noise alone."""


def fresh(count, noise, seed=0, begin=0):
    """Samples (count, C) of coils at rest, whose columns have these noises (C,), codes rms."""
    rng = np.random.default_rng(seed)
    noise = np.asarray(noise, float)
    time_s = (begin + np.arange(count))[:, None] / RATE_HZ
    wave = np.cos(2 * np.pi * TONES * time_s + np.arange(8)).sum(axis=1)
    signal = wave[:, None] * np.linspace(100, 600, noise.size)
    return np.rint(signal + noise * rng.standard_normal((count, noise.size))).astype(np.int16)


def feed(watch, samples, block=40):
    for k in range(0, len(samples), block):
        watch.take(samples[k : k + block])


class TestRings:
    @settings(max_examples=30, deadline=None)
    @given(
        length=st.integers(1, 80_000),
        alignment=st.integers(0, 79),
        block=st.sampled_from([1, 7, 40, 600]),
        column=st.sampled_from([None, 0, 2]),
        seed=st.integers(0, 2**31),
    )
    def test_any_ring_is_found_within_a_window_of_20_ms(
        self, length, alignment, block, column, seed
    ):
        watch = RepetitionWatch(3, RATE_HZ, TONES)
        past = fresh(length + alignment + 200, [2.4, 2.4, 2.4], seed)
        feed(watch, past, 600)
        ring = past[len(past) - length :]
        again = np.tile(ring, (1600 // length + 1, 1))[:1600]
        now = fresh(1600, [2.4, 2.4, 2.4], seed + 1, len(past))
        columns = slice(None) if column is None else [column]
        now[:, columns] = again[:, columns]
        feed(watch, now, block)
        ages = watch.ages(len(past) + 800)
        assert (ages[columns] % length == 0).all() and (ages[columns] > 0).all()
        assert (np.delete(ages, np.arange(3)[columns]) == 0).all()
        assert watch.repeats == (column is None)

    def test_a_ring_of_all_columns_is_found_as_soon_as_it_proves_itself(self):
        """One column's anchor is enough for all: a window may end just behind the first of it."""
        watch = RepetitionWatch(42, RATE_HZ, TONES)
        past = fresh(20_000, np.full(42, 2.4))
        feed(watch, past, 400)
        feed(watch, past[-4000 : -4000 + 48])
        assert (watch.ages(20_000) == 4000).all()

    def test_a_ring_that_ends_is_forgotten_with_its_samples(self):
        watch = RepetitionWatch(2, RATE_HZ, TONES)
        past = fresh(8000, [2.4, 2.4])
        feed(watch, past)
        feed(watch, past[-2000:])
        assert (watch.ages(9000) == 2000).all() and watch.repeats
        feed(watch, fresh(4000, [2.4, 2.4], 1, 10_000))
        assert (watch.ages(9960) == 2000).all(), 'a window with some of the old samples'
        assert (watch.ages(10_010) == 0).all(), 'a few may be the same by chance'
        assert not watch.repeats

    def test_a_held_value_and_a_silent_column(self):
        watch = RepetitionWatch(3, RATE_HZ, TONES)
        samples = fresh(9000, [2.4, 2.4, 2.4])
        samples[8300:, 0] = samples[8299, 0]
        samples[:, 1] = 0
        feed(watch, samples)
        assert watch.ages(8200)[0] == 1 and watch.ages(8200)[1] > 0 and watch.ages(8200)[2] == 0

    def test_a_repetition_is_seen_across_lost_blocks(self):
        """What was lost is unknown; what comes after it is compared with what came before."""
        watch = RepetitionWatch(2, RATE_HZ, TONES)
        past = fresh(8000, [2.4, 2.4])
        feed(watch, past)
        feed(watch, past[4000:4400])
        watch.skip(80)
        feed(watch, past[4480:5280])
        assert (watch.ages(8480) == 4000).all()
        watch.skip(10**7)
        feed(watch, past[4480:5280])
        assert (watch.ages(watch.position - 800) == 0).all(), 'longer ago than it remembers'


class TestFresh:
    def test_fresh_samples_of_any_noise_are_never_old(self):
        """From 2.4 codes, as a converter of 16 bits has, to less than a tenth of a code."""
        noise = [2.4, 1.0, 0.5, 0.3, 0.2, 0.1, 0.08]
        watch = RepetitionWatch(len(noise), RATE_HZ, TONES)
        for k in range(10):
            feed(watch, fresh(16_000, noise, k, 16_000 * k), 400)
            assert not (watch.ages(16_000 * k) > 0).any()
        assert not watch.noiseless.any()

    def test_how_long_a_run_must_be_follows_from_the_noise_that_is_seen(self):
        """Gaussian noise of s codes coincides in 1 / (2 s sqrt(pi)) of the samples if s > 1/2."""
        noise = np.array([0.5, 0.7, 1.0])
        watch = RepetitionWatch(3, RATE_HZ, TONES)
        feed(watch, fresh(80_000, noise), 400)
        watch.ages(0)
        bits = -np.log2(1 / (2 * noise * np.sqrt(np.pi)))
        assert watch.needed == pytest.approx(EVIDENCE_BITS / bits, rel=0.25)

    def test_a_column_without_noise_is_said_to_have_none(self):
        watch = RepetitionWatch(2, RATE_HZ, TONES)
        feed(watch, fresh(40_000, [2.4, 0.0]), 400)
        assert (watch.ages(39_000) > 0).tolist() == [False, True]
        quiet = fresh(40_000, [2.4, 0.04])
        watch.reset()
        feed(watch, quiet, 400)
        watch.ages(0)
        stale = (watch.ages(39_000) > 0) | watch.noiseless
        assert stale.tolist() == [False, True]

    def test_overloaded_samples_do_not_count_as_quiet(self):
        watch = RepetitionWatch(1, RATE_HZ, TONES)
        clipped = np.clip(100.0 * fresh(40_000, [2.4]), -32768, 32767).astype(np.int16)
        feed(watch, clipped, 400)
        feed(watch, fresh(8000, [2.4], 1), 400)
        assert not watch.noiseless.any() and watch.ages(40_000 + 4000)[0] == 0


class TestRecalling:
    def test_blocks_that_came_before_are_known(self):
        watch = RepetitionWatch(2, RATE_HZ)
        samples = fresh(4000, [2.4, 2.4])
        feed(watch, samples)
        assert watch.matches_history(400, samples[400:440]) is True
        assert watch.matches_history(440, samples[400:440]) is False
        assert watch.matches_history(3990, samples[:40]) is False
        watch.skip(400)
        assert watch.matches_history(4040, samples[:40]) is None
        feed(watch, fresh(200_000, [2.4, 2.4]), 400)
        assert watch.matches_history(400, samples[400:440]) is False

    @pytest.mark.parametrize(('columns', 'rate_hz'), [(0, 4e4), (3, 0.0), (3, float('nan'))])
    def test_refusals(self, columns, rate_hz):
        with pytest.raises(ParameterError, match='repetitions need columns and a rate'):
            RepetitionWatch(columns, rate_hz)

    def test_memory_is_bounded(self):
        watch = RepetitionWatch(1000, 4e5)
        assert watch._history.nbytes <= 64e6 and len(RepetitionWatch(2, 4e5)._history) <= 2**20
