"""When a node gives up on what waits: not after a pause or a burst, only when it is too slow."""

import pytest

from anser_ros.nodes.streams.one_source import Backlog, too_slow


def backlog(spacing_s, work_s, stamp_spacing_s=None):
    one = Backlog()
    for i in range(30):
        stamp_s = i * (spacing_s if stamp_spacing_s is None else stamp_spacing_s)
        one.arrived(10**9 + round(i * spacing_s * 1e9), 10**9 + round(stamp_s * 1e9))
        one.worked(work_s)
    return one


@pytest.mark.parametrize(
    ('work_s', 'age_s', 'hopeless'),
    [
        (0.002, 0.3, False),  # a pause, soon made up for
        (0.002, 10.0, True),
        (0.025, 0.05, False),  # too slow, but not late yet
        (0.025, 0.07, True),
        (0.019, 0.07, True),  # would take more than a second
        (0.010, 0.07, False),
    ],
)
def test_what_is_hopeless(work_s, age_s, hopeless):
    assert backlog(0.02, work_s).is_hopeless(age_s) is hopeless


def test_a_burst_is_no_faster_than_its_stamps():
    assert not backlog(0.0, 0.002, stamp_spacing_s=0.02).is_hopeless(0.3)
    assert backlog(0.0, 0.002, stamp_spacing_s=0.001).is_hopeless(0.3)


def test_work_that_can_wait_leaves_out_at_most_two_frames_in_a_row():
    one = Backlog(0.02)
    assert not one.gives_way(0.019) and not Backlog().gives_way(1.0)
    assert [one.gives_way(0.021) for _ in range(7)] == [True, True, False] * 2 + [True]
    assert not one.gives_way(0.01), 'no frame waits'
    assert one.gives_way(0.021) and one.gives_way(0.021)


def test_a_known_spacing_needs_no_arrivals():
    one = Backlog(0.02)
    for _ in range(30):
        one.worked(0.025)
    assert one.is_hopeless(0.07) and not one.is_hopeless(0.05)
    for _ in range(30):
        one.worked(0.002)
    assert not one.is_hopeless(0.07)


def test_what_is_said_has_the_share_and_the_load(monkeypatch):
    monkeypatch.setattr('os.getloadavg', lambda: (6.06, 1.0, 1.0))
    monkeypatch.setattr('os.cpu_count', lambda: 2)
    said = 'computer too slow: 40 % of windows skipped, load 6.1 on 2 cores'
    assert too_slow(20, 30) == said
    assert too_slow(1, 300).startswith('computer too slow: less than 1 % of')
    assert too_slow(0, 50) == ''


def test_one_slow_frame_says_nothing():
    one = backlog(0.02, 0.002)
    one.worked(2.0)
    assert not one.is_hopeless(0.3)
    assert not Backlog().is_hopeless(5.0)
