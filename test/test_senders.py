"""Streams of a node: two senders of one topic, a single one again, and what waits too long."""

import pytest
from std_msgs.msg import String

from anser_ros.integrity.streams import SILENT_S, Senders
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.streams import one_source
from anser_ros.nodes.streams.one_source import (
    LOOK_S,
    NUMBER,
    SETTLED_S,
    Backlog,
    OneSource,
    too_slow,
)

PERIOD_S = 0.02


def feed(sources, senders, publishers, begin_s=0.0, period_s=PERIOD_S, lasting=None):
    """Give messages by their numbers; return the time after the last, and which were believed."""
    now_s, believed = begin_s, []
    for number in senders:
        believed.append(sources.take(number, publishers, now_s, lasting))
        now_s += period_s
    return now_s, believed


def test_one_sender_is_believed_with_losses_pauses_and_from_any_number():
    sources = Senders('tool/flux')
    now_s, believed = feed(sources, [700, 701, 705, 706, 900, 901], 1)
    assert all(believed)
    assert all(feed(sources, [950, 951], 1, now_s + 5.0)[1])
    assert sources.complaint == ''


@pytest.mark.parametrize('first', [1, 3, 499, 500, 502, 9000])
@pytest.mark.parametrize('publishers', [1, 2])
def test_no_message_of_a_second_is_believed_once_numbers_can_tell(first, publishers):
    sources = Senders('tool/flux')
    now_s, _ = feed(sources, range(480, 501), 1)
    second = range(first, first + 30)
    mixed = [n for pair in zip(second, range(501, 531), strict=True) for n in pair]
    _, believed = feed(sources, mixed, publishers, now_s)
    # Until the graph knows both, a jump ahead looks like a loss, till the first one goes on.
    assert not any(believed[0 if publishers == 2 or first <= 500 else 1 :])
    assert sources.complaint == 'two publishers of tool/flux'


@pytest.mark.parametrize('publishers', [1, 2])
def test_one_that_was_started_anew_is_taken_within_a_second(publishers):
    sources = Senders('tool/flux')
    now_s, _ = feed(sources, range(1, 100), 1)
    later_s, believed = feed(sources, range(1, 100), publishers, now_s + 0.3)
    first = believed.index(True)
    assert 0.0 < 0.3 + first * PERIOD_S <= SILENT_S
    assert all(believed[first:])
    assert all(feed(sources, range(1, 9), publishers, later_s + SILENT_S)[1])
    assert sources.look(publishers, later_s + 9.0) == ''


def test_two_that_last_contradict_each_other_until_it_is_asked_anew():
    sources = Senders('field_model')
    assert sources.take(1, 1, 0.0, 'a')
    assert sources.look(1, 30.0) == ''
    assert sources.take(1, 2, 60.0, 'a'), 'what says the same is no contradiction'
    assert not sources.take(2, 2, 61.0, 'b')
    assert sources.look(2, 200.0) == 'two publishers of field_model'
    assert sources.look(1, 201.0), 'which of them has gone cannot be told'
    sources.forget()
    assert sources.look(1, 202.0) == ''
    assert sources.take(1, 1, 202.0, 'b')


def test_a_single_sender_may_say_otherwise():
    sources = Senders('field_model')
    assert sources.take(1, 1, 0.0, 'a')
    assert sources.take(2, 1, 50.0, 'b')
    assert sources.take(3, 1, 51.0)
    assert sources.take(4, 1, 51.02, 'c')
    assert sources.take(1, 1, 59.0, 'c'), 'its successor, who says the same'


@pytest.mark.parametrize('number', [1, 2, 3, 9])
def test_who_says_otherwise_is_no_successor_before_it_is_asked_anew(number):
    sources = Senders('setup', is_constant=True)
    assert sources.take(1, 1, 0.0, 'a')
    assert sources.take(2, 1, 0.0, 'a')
    assert not sources.take(number, 1, 60.0, 'b'), 'a graph may not know the second publisher yet'
    assert sources.look(1, 60.5) == 'two publishers of setup'
    sources.forget()
    assert sources.take(1, 1, 61.0, 'b')


def test_without_numbers_the_graph_decides():
    sources = Senders('tool/flux')
    assert sources.take(None, 1, 0.0)
    assert not sources.take(None, 2, 0.1)
    assert sources.complaint == '2 publishers of tool/flux'
    assert sources.take(None, 1, 0.2)


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
    assert not one.gives_way(0.009) and not Backlog().gives_way(1.0)
    assert [one.gives_way(0.011) for _ in range(7)] == [True, True, False] * 2 + [True]
    assert not one.gives_way(0.009), 'there is time'
    assert one.gives_way(0.011) and one.gives_way(0.011)


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


pytest.importorskip('rclpy')


class Node:
    """Stands for a node: the graph knows as many publishers as it is told."""

    def __init__(self):
        self.publishers, self.subscriptions = 1, 0

    def resolve_topic_name(self, name):
        return name

    def create_subscription(self, *_given):
        self.subscriptions += 1
        return object()

    def destroy_subscription(self, _subscription):
        pass

    def count_publishers(self, _name):
        return self.publishers

    def warn(self, _kind, _text):
        pass


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(one_source.time, 'monotonic', lambda: now[0])
    return now


@pytest.mark.parametrize('lease_s', [0.0, 3.0])
def test_a_successor_that_goes_on_publishing_is_believed_when_the_graph_has_one(clock, lease_s):
    """The one before said something that holds; the new one says another thing in each message."""
    node, got = Node(), []
    source = OneSource(
        node, String, 'field_model', got.append, qos.MODELS, lasting=lambda message: message
    )
    source._take('wrong', {NUMBER: 500})
    assert got == ['wrong']
    node.publishers = 2 if lease_s else 1
    begin, number = clock[0], 0
    while 'right' not in got and clock[0] < begin + 10.0:
        clock[0] += 0.04
        number += 1
        if clock[0] > begin + lease_s:
            node.publishers = 1
        before = node.subscriptions
        source._take('right', {NUMBER: number})
        assert source.complaint or got[-1] == 'right' or node.subscriptions > before
    waited = clock[0] - begin - lease_s
    assert SETTLED_S < waited < SETTLED_S + LOOK_S + 0.1, 'and not before it is certain'
    assert node.subscriptions == 2
