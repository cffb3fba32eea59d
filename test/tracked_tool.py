"""The tool of the tracker's tests, the model of its board, and the way that it goes."""

import numpy as np
from tracking_world import certain_model, random_pose, triaxial_tool

from anser_ros.physics.rotations import rotation_of_vector

MODEL = certain_model()
TOOL = triaxial_tool()
CHANNELS = TOOL.channel
STEP_NS = 20_000_000


def path(count, seed=0):
    """A tool that moves and turns smoothly: stamps, positions, rotations."""
    rng = np.random.default_rng(seed)
    _, rotation = random_pose(rng)
    for i in range(count):
        t = i / 50.0
        position = np.array(
            [0.08 * np.sin(0.9 * t), 0.08 * np.cos(0.7 * t), 0.15 + 0.04 * np.sin(0.5 * t)]
        )
        turn = rotation_of_vector(np.array([0.4 * t, 0.3 * np.sin(t), 0.2 * t]))
        yield (i + 1) * STEP_NS, position, turn @ rotation


def one_frame(tracker, flux, stamp=STEP_NS, **others):
    return {e.name: e for e in tracker.update(stamp, CHANNELS, flux, **others)}
