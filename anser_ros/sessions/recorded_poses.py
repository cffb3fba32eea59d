"""Reads the poses that nodes published during a recording."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.stamps import stamp_of
from anser_ros.wire.bag import MessageDecoder, Salvage, iter_messages
from anser_ros.wire.recorded import PoseStream, pose_numbers

Array = NDArray[np.float64]


def published_poses(
    path: str | os.PathLike[str], topics: Sequence[str] | None = None, salvage: Any = None
) -> dict[str, PoseStream]:
    """Return what each PoseStamped topic of a bag carries, of some topics or of all.

    ``salvage``: a `wire.bag.Salvage`, which takes what could not be read.
    """
    # Nodes that read no bag run where the packages that read bags are not installed.
    from anser_ros.wire.bag import POSE_TYPE

    rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in topics or ()}
    stamps: dict[str, list[int]] = {topic: [] for topic in topics or ()}
    decoder = MessageDecoder()
    for raw in iter_messages(path, salvage or Salvage()):
        if raw.type_name == POSE_TYPE and (topics is None or raw.topic in rows):
            message = decoder.decode(raw)
            stamps.setdefault(raw.topic, []).append(stamp_of(message))
            rows.setdefault(raw.topic, []).append(pose_numbers(message.pose))
    found = {}
    for topic, values in rows.items():
        table = np.array(values, dtype=np.float64).reshape(-1, 7)
        stamp = np.array(stamps[topic], dtype=np.int64)
        found[topic] = PoseStream(stamp, table[:, :3], table[:, 3:])
    return found
