"""Lists names outside a node's namespace, which two boards on one graph must not share.

Poses of other trackers, the clock of a replay and the frames in ``/tf`` are everybody's by
default; a second board has others by these parameters.
"""

from typing import Any

from anser_ros.nodes.runtime.parameters import parameter
from anser_ros.wire.pose_topics import OPTICAL, TRACKED

STALE_AFTER_S = 0.3
"""Time without fluxes, or poses, s, after which a sensor is stale, unless parameters differ."""


def optical_parameter() -> Any:
    """Return the parameter of a node that has to do with optical poses."""
    return parameter(OPTICAL.rstrip('/'), 'namespace of the optical poses: NAMESPACE/BODY/pose')


def tracked_parameter() -> Any:
    """Return the parameter of a node that has to do with the poses of another tracker."""
    return parameter(
        TRACKED.rstrip('/'), "namespace of another tracker's poses: NAMESPACE/SENSOR/pose"
    )
