"""Processor time of a diagnosis of poses (with faults of `bench_poses.py`) and of a correction."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE), str(HERE.parents[1]), str(HERE.parent)]

from pose_faults import KINDS  # noqa: E402
from pose_world import World  # noqa: E402

from anser_ros.apps.poses.corrector import (  # noqa: E402
    PoseCorrector,
    to_model,
)
from anser_ros.apps.poses.diagnosis import diagnose_poses  # noqa: E402


def rows() -> Iterator[dict[str, Any]]:
    """Processor time of the longest session that is promised, and of a corrected pose."""
    for name in ('bent', 'filtered'):
        world = World(305_900, duration=60.0, sensors=4, rate=100.0, optical_rate=60.0)
        KINDS[name].change(world, KINDS[name].sizes[1])
        session, start = world.session(), time.process_time()
        found = diagnose_poses(session)
        yield {
            'name': f'poses: {name}, 60 s, four sensors of 100 Hz, processor time',
            'value': time.process_time() - start, 'unit': 's', 'target': 20.0,
        }  # fmt: skip
        if name == 'filtered':
            continue
        corrector, poses = PoseCorrector(to_model(found)), session.sensors['sensor_0']
        took = []
        for at, place, turn in zip(poses.time, poses.position, poses.quaternion, strict=True):
            start = time.perf_counter()
            corrector.correct('sensor_0', int(1e9 * at), place, turn)
            took.append(1e3 * (time.perf_counter() - start))
        yield {
            'name': 'poses: corrector with a map, a pose, median', 'value': float(np.median(took)),
            'unit': 'ms', 'target': 0.3,
        }  # fmt: skip
