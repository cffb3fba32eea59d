"""Two senders of one topic are noticed by the numbers of their messages, one never is."""

import pytest

from anser_ros.integrity.streams import SILENT_S, Senders

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
