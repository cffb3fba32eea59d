"""Runs acquisition, field model and tracker in one process, which hands frames on as objects.

A frame is demodulated and tracked in one thread, and its poses go out first; then its fluxes are
published, and last another thread refits the model, so that each pose uses the model of the window
before. Parameters and names are given to one node as ``-p tracker:gate:=4`` and
``-r tracker:__node:=NAME``.
"""

import sys

from anser_ros.nodes.acquisition import Acquisition
from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.runtime.process import TURN_S, main
from anser_ros.nodes.tracker import TrackerNode

CHAIN = (Acquisition, FieldModelNode, TrackerNode)
"""In the order in which frames pass them: each offers what the next ones take."""

if __name__ == '__main__':
    sys.setswitchinterval(TURN_S)
    sys.exit(main(CHAIN, name='live'))
