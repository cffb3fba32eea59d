"""The intake of frames: each fault has one name, whoever asks."""

from collections import Counter

import numpy as np
import pytest

from anser_ros.errors import LayoutError
from anser_ros.frames.intake import FAULTS, MISSING_CODE, Intake, reading_codes, value_codes
from anser_ros.stamps import SECOND_NS, Order, order_of
from anser_ros.wire.points import DROPPED, SATURATED, STALE

CHANNELS = np.array([5, 3, 8, 1, 7, 2, 9, 4])


def kinds_of(frame):
    return [None if FAULTS[code] is None else FAULTS[code].kind for code in frame.codes.tolist()]


def test_every_fault_has_its_name_and_the_table_has_the_order():
    channels = np.array([1, 2, 3, 4, 5, 7, 8, 66])
    flux = 1e-7 * (channels[:, None] + 1j * np.arange(1, 4))
    flags = np.array([DROPPED, 0, SATURATED, 0, 0, 16, STALE, 0])
    flux[1, 1], flux[3, 2] = complex(2.0, 0.0), complex(np.nan, 5.0)
    frame = Intake(CHANNELS).judge(1, channels, flux, flags)
    assert kinds_of(frame) == [
        None, 'saturated', 'stale', 'dropped', 'flagged', 'absurd', 'missing', 'not_finite',
    ]  # fmt: skip
    assert frame.kinds == Counter(kind for kind in kinds_of(frame) if kind)
    np.testing.assert_array_equal(frame.flux[0], flux[4])
    assert frame.usable.tolist() == [True] + 7 * [False]
    assert np.isnan(frame.flux[6]).all() and frame.flux[7, 1] == flux[3, 1]
    assert frame.living is None
    np.testing.assert_array_equal(value_codes(frame.flux[[0, 5, 6, 7]]), [0, 7, 6, 6])


def test_a_recording_is_judged_as_live_frames_are():
    rng = np.random.default_rng(40)
    flux = 1e-7 * np.exp(2j * np.pi * rng.random((300, 8, 3)))
    odd = rng.random(flux.shape) < 0.05
    flux[odd] = rng.choice([np.nan, 2.0, 1j * np.inf, 0.0, -3j], odd.sum())
    flags = rng.integers(0, 32, (300, 8)) * (rng.random((300, 8)) < 0.5)
    intake = Intake(CHANNELS)
    live = np.array(
        [intake.judge(1, CHANNELS, f, m).codes for f, m in zip(flux, flags, strict=True)]
    )
    recorded = reading_codes(flux, flags)
    assert set(np.unique(recorded)) == set(range(len(FAULTS) - 1)) - {MISSING_CODE}
    np.testing.assert_array_equal(recorded, live)


@pytest.mark.parametrize(
    'stamp_s, last_s, order',
    [
        (7, 0, Order.NEXT), (7, 6.5, Order.NEXT), (7.5, 6.5, Order.NEXT), (7, 7, Order.SAME),
        (7, 7.5, Order.LATE), (7, 8, Order.LATE), (7, 8.001, Order.BACK), (9, 7, Order.AHEAD),
    ],
)  # fmt: skip
def test_a_stamp_follows_the_last_one_in_one_of_five_ways(stamp_s, last_s, order):
    assert order_of(round(stamp_s * SECOND_NS), round(last_s * SECOND_NS)) is order


@pytest.mark.parametrize('spares', [False, True])
@pytest.mark.parametrize('silence', [0.0, np.nan, np.inf])
def test_a_dead_emitter_is_no_fault_of_the_sensors_for_who_goes_on_without(spares, silence):
    counts, flux = Counter(), np.full((8, 4), 1e-7 + 0j)
    flux[:, 2] = silence
    intake = Intake(CHANNELS, lambda name, by: counts.update({name: by}), spares_dead=spares)
    frame = intake.admit(1, CHANNELS, flux, None, ('a', 'b', 'c', 'd'))
    assert intake.dead == ('c',) and counts['frames_dead_emitter'] == 1
    assert frame.living.tolist() == [True, True, False, True]
    assert frame.usable.all() == (spares or silence == 0.0)


def test_the_order_of_stamps_is_judged_and_counted():
    counts, flux = Counter(), np.full((8, 4), 1e-7 + 0j)
    intake = Intake(CHANNELS, lambda name, by: counts.update({name: by}))
    stamps = [10, 10, 11, 5, 5.5, 20]
    frames = [intake.admit(round(s * SECOND_NS), CHANNELS, flux) for s in stamps]
    assert [f is None for f in frames] == [False, True, False, False, False, False]
    assert [f.goes_back for f in frames if f is not None] == [False, False, True, False, False]
    assert counts == {'frames': 5, 'duplicates': 1, 'time_jumps': 1, 'time_jumps_forward': 1}


def test_what_is_no_frame_is_refused_and_changes_nothing():
    counts, flux = Counter(), np.full((8, 4), 1e-7 + 0j)
    intake = Intake(CHANNELS, lambda name, by: counts.update({name: by}))
    for arguments, word in (
        ((0, CHANNELS, flux), 'positive stamp'),
        ((1, CHANNELS[:3], flux), 'need s channels'),
        ((1, np.zeros(8, int), flux), 'appears twice'),
        ((1, CHANNELS, flux, None, ('a',)), 'has 1 emitters, the fluxes 4'),
    ):
        with pytest.raises(LayoutError, match=word):
            intake.admit(*arguments)
    assert not counts and intake.last_ns == 0
