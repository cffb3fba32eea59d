"""A device's ticks beside its samples, which are 40 a millisecond."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anser_ros.signals.window import TickCheck


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
