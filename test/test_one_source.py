"""A latched topic is asked for again once it has a single sender."""

import pytest

pytest.importorskip('rclpy')

from std_msgs.msg import String

from anser_ros.nodes.runtime import qos
from anser_ros.nodes.streams import one_source
from anser_ros.nodes.streams.one_source import LOOK_S, NUMBER, SETTLED_S, OneSource


class Node:
    """Stands for a node: the graph knows as many publishers as it is told."""

    def __init__(self):
        self.publishers, self.subscriptions = 1, 0

    def resolve_topic_name(self, name):
        return name

    def create_subscription(self, *_given, handed):
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
