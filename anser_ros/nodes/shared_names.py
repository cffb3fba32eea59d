"""Lists names outside a node's namespace, which two boards on one graph must not share.

Poses of an optical tracker, the clock of a replay and the frames in ``/tf`` are everybody's by
default; a second board has others by these parameters.
"""

from typing import Any

from anser_ros.nodes.parameters import parameter
from anser_ros.wire.setup import topic_of

OPTICAL = '/optical'
"""Where an optical tracker publishes, and what its poses are called in bags."""


def optical_parameter() -> Any:
    """Return the parameter of a node that has to do with optical poses."""
    return parameter(OPTICAL, 'namespace of the optical poses: NAMESPACE/BODY/pose')


def optical_topic(namespace: str, body: str) -> str:
    """Return the topic of a body's optical pose."""
    return f'{namespace.rstrip("/")}/{topic_of(body)}/pose'
