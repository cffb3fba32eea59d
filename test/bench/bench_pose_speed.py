"""Processor time of a diagnosis of poses (with faults of `bench_poses.py`) and of a correction."""

from __future__ import annotations

import time
from collections.abc import Iterator

import harness
import numpy as np
from pose_faults import KINDS
from pose_world import World

from anser_ros.apps.poses.corrector import PoseCorrector, to_model
from anser_ros.apps.poses.diagnosis import diagnose_poses


def rows() -> Iterator[harness.Row]:
    """Processor time of the longest session that is promised, and of a corrected pose."""
    for name in ('bent', 'filtered'):
        world = World(305_900, duration=60.0, sensors=4, rate=100.0, optical_rate=60.0)
        KINDS[name].change(world, KINDS[name].sizes[1])
        session, start = world.session(), time.process_time()
        found = diagnose_poses(session)
        yield harness.row(
            f'poses: {name}, 60 s, four sensors of 100 Hz, processor time',
            time.process_time() - start, 's', target=10.0,
        )  # fmt: skip
        if name == 'filtered':
            continue
        corrector, poses = PoseCorrector(to_model(found)), session.sensors['sensor_0']
        took = []
        for at, place, turn in zip(poses.time, poses.position, poses.quaternion, strict=True):
            start = time.perf_counter()
            corrector.correct('sensor_0', int(1e9 * at), place, turn)
            took.append(1e3 * (time.perf_counter() - start))
        yield harness.row(
            'poses: corrector with a map, a pose, median', float(np.median(took)), 'ms', target=0.3
        )


if __name__ == '__main__':
    harness.print_rows(rows())
