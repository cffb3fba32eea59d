"""Runs acquisition, field model and tracker in one process, whose frames pass them as objects.

A frame is demodulated, tracked and its model refitted in one thread, and its poses go out first:
each is by the model of the window before. What is published of it is for all others. Parameters
and names are given to one node as ``-p tracker:gate:=4`` and ``-r tracker:__node:=NAME``.
"""

import sys

from anser_ros.chain.chain import Chain
from anser_ros.nodes.acquisition import Acquisition
from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.tracker import TrackerNode
from anser_ros.parallel import TURN_S

CHAIN = (Acquisition, FieldModelNode, TrackerNode)
"""In the order in which they are made and joined."""


def join(acquisition: Acquisition, field_model: FieldModelNode, tracker: TrackerNode) -> None:
    """Let acquisition take its frames through both halves of the chain."""
    acquisition.chain = Chain(field_model, tracker, lags=True)


if __name__ == '__main__':
    sys.setswitchinterval(TURN_S)
    sys.exit(main(CHAIN, name='live', join=join))
