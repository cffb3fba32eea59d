"""Takes topics of poses for a watcher, and reports what it found in them."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped

from anser_ros.apps.poses.live_look import PoseSighting, PoseWatch
from anser_ros.apps.poses.sequence import REFERENCE, PoseWindow
from anser_ros.errors import ParameterError
from anser_ros.nodes.operator_words import findings_words, titles_of
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.streams.one_source import OneSource
from anser_ros.stamps import stamp_of
from anser_ros.wire.recorded import ENDING, TRACKED, pose_numbers

QUIET_S = 2.0
"""Time without a pose on a topic, s, after which it counts as silent."""


def sensor_of(topic: str) -> str:
    """Return a sensor's name by its topic: what is between ``/tracked/`` and ``/pose``, or all."""
    return topic.removeprefix(TRACKED).removesuffix(ENDING).strip('/').replace('/', '_')


class PoseStreams:
    """Subscribes to topics of tracked poses and of a reference, as `watcher.Streams` has it.

    Raises `ParameterError` when two topics give sensors of the same name, or the reference is
    tracked as well.
    """

    WHAT = 'poses'

    def __init__(self, node: AnserNode, table: Any) -> None:
        tracked, reference = table.tracked_poses, table.reference_pose
        names = {topic: sensor_of(topic) for topic in tracked}
        if len({*names.values(), REFERENCE}) < len(tracked) + 1 or reference in names:
            raise ParameterError(
                f'tracked_poses: the topics must give sensors of different names, none called '
                f'{REFERENCE} or the reference: {", ".join(tracked)}'
            )
        if not reference and len(tracked) < 2:
            raise ParameterError('reference_pose: a single sensor needs a reference')
        self._topics = {**names, **({reference: REFERENCE} if reference else {})}
        self._received: dict[str, float] = dict.fromkeys(self._topics, 0.0)
        self.window, self.watch = PoseWindow(list(names.values()), table.window_s), PoseWatch()
        self.received_s = 0.0
        self._node = node
        self.sources = [
            OneSource(node, PoseStamped, topic, partial(self._on_pose, topic, name), qos.OTHERS)
            for topic, name in self._topics.items()
        ]

    def _on_pose(self, topic: str, name: str, message: PoseStamped) -> None:
        self.window.take(name, stamp_of(message), pose_numbers(message.pose))
        self._received[topic] = time.monotonic()
        if name != REFERENCE:
            self.received_s = self._received[topic]
        self._node.count('poses')

    def quiet_topics(self) -> tuple[str, ...]:
        """Return topics on which nothing comes now."""
        now_s = time.monotonic()
        return tuple(topic for topic, at in self._received.items() if now_s - at > QUIET_S)

    def look(self) -> Callable[[], PoseSighting] | None:
        """Return what looks at the window now, at those topics on which something comes."""
        session = self.window.session(without=[self._topics[t] for t in self.quiet_topics()])
        return None if session is None else partial(self.watch.look, session)

    def on_parameters(self, old: Any, new: Any) -> None:
        """Go on: no live parameter is about poses."""

    def words(self, seen: PoseSighting) -> str:
        """Return what was seen as one line for an operator."""
        size = '' if np.isnan(seen.after_m) else f'error {1e3 * seen.after_m:.2f} mm'
        if seen.findings:
            with_them = f'{size} with it corrected' if size else ''
            parts = [findings_words(seen.findings), with_them, seen.remark]
            return '; '.join(filter(None, parts))
        if seen.remark:
            return '; '.join(filter(None, [seen.remark, size]))
        return f'nothing found; {size}'

    def values(self, seen: PoseSighting) -> dict[str, object]:
        """Return the figures of what was seen, by name."""
        return {
            'poses_compared': seen.poses,
            'position_rmse_before_m': seen.before_m,
            'position_rmse_after_m': seen.after_m,
            'position_floor_m': seen.jitter_m,
            'misfit_of_known_frames_m': seen.misfit_m,
            'unexplained': seen.unexplained,
            'findings': titles_of(seen.findings),
            'depends_on': ', '.join(seen.depends_on),
        }
