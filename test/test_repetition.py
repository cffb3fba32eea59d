"""What a column said before is found, whatever repeats it, and fresh samples are not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anser_ros.errors import ParameterError
from anser_ros.signals.repetition import EVIDENCE_BITS, RepetitionWatch

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
