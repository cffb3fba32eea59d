"""Corrects the poses of another tracker by a model that `diagnose --poses` made."""

import sys
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped

from anser_ros.apps.poses.corrector import MODEL_SCHEMA, OK, OUTSIDE, PoseCorrector
from anser_ros.errors import ParameterError
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import parameter, tracked_parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.stamps import set_stamp, stamp_of
from anser_ros.wire.recorded import pose_numbers
from anser_ros.wire.setup import topic_of
from anser_ros.wire.text_files import read_document

QUIET_S = 1.0
"""Silence of a sensor, s, after which it is stale; trackers of poses give five a second."""


@dataclass(frozen=True)
class CorrectorParameters:
    """Holds the parameters of the corrector."""

    model: str = parameter('', 'model.yaml of `anser diagnose --poses`')
    tracked: str = tracked_parameter()
    frame_id: str = parameter('tracker', 'frame of the corrected poses')


class Corrector(AnserNode):
    """Takes ``/tracked/<sensor>/pose``, gives ``corrected/<sensor>/pose`` with covariance."""

    NAME = 'corrector'
    EXAMPLE = '--ros-args -p model:=result/model.yaml -p tracked:=/tracked'
    PARAMETERS = CorrectorParameters

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if not self.parameters.model:
            raise ParameterError('model must name the model.yaml of `anser diagnose --poses`')
        self._corrector = PoseCorrector(read_document(self.parameters.model, MODEL_SCHEMA))
        self._outputs: dict[str, tuple[Any, Any]] = {}
        self._states: dict[str, Counter[str]] = {}
        self._latest: dict[str, tuple[float, str, float]] = {}
        for sensor in sorted(self._corrector.sensors):
            stem = topic_of(sensor)
            self._outputs[sensor] = (
                self.create_publisher(PoseStamped, f'corrected/{stem}/pose', qos.STREAM),
                self.create_publisher(
                    PoseWithCovarianceStamped, f'corrected/{stem}/pose_with_covariance', qos.STREAM
                ),
            )
            self._states[sensor] = Counter()
            topic = f'{self.parameters.tracked}/{stem}/pose'
            self.create_subscription(
                PoseStamped, topic, partial(self._on_pose, sensor), qos.OTHERS
            )

    def part_statuses(self) -> list[Status]:
        """Return the state of every sensor."""
        statuses = []
        for sensor, counts in self._states.items():
            at, state, sigma = self._latest.get(sensor, (-np.inf, 'no pose yet', np.nan))
            silent = time.monotonic() - at > QUIET_S
            level = Level.STALE if silent else Level.OK if state == OK else Level.WARN
            values = {'sigma_position_m': sigma, **{f'poses_{k}': n for k, n in counts.items()}}
            statuses.append(Status(sensor, level, 'stale' if silent else state, values))
        return statuses

    def _on_pose(self, sensor: str, message: PoseStamped) -> None:
        given = np.array(pose_numbers(message.pose))
        pose = self._corrector.correct(sensor, stamp_of(message), given[:3], given[3:])
        sigma = float(np.sqrt(np.trace(pose.covariance[:3, :3])))
        self._states[sensor][pose.state] += 1
        self._latest[sensor] = time.monotonic(), pose.state, sigma
        if pose.state not in (OK, OUTSIDE):
            return
        plain, full = PoseStamped(), PoseWithCovarianceStamped()
        for one, out in ((plain, plain.pose), (full, full.pose.pose)):
            one.header.frame_id = self.parameters.frame_id
            set_stamp(one.header.stamp, pose.stamp_ns)
            out.position.x, out.position.y, out.position.z = pose.position.tolist()
            q = out.orientation
            q.x, q.y, q.z, q.w = pose.quaternion.tolist()
        full.pose.covariance = pose.covariance.ravel()
        for publisher, one in zip(self._outputs[sensor], (plain, full), strict=True):
            publisher.publish(one)


if __name__ == '__main__':
    sys.exit(main(Corrector))
