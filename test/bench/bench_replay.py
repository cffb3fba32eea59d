"""The main job: effects/s01 replayed through the real nodes over DDS, against the optical poses.

The model is calibrated on effects/factory in the same run; the rival is the article's own starting
point, the nominal Biot-Savart model, on the same session. Where the recordings are missing, the
small simulated bags of this package stand in, and the rows say so.
"""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import harness
import numpy as np
from chain import replay_through_nodes

from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model, model_for, save_model
from anser_ros.sessions.tracked_session import metrics, track_session
from anser_ros.wire.setup import topic_of


def recordings() -> tuple[Path, Path, str]:
    """Calibration scan, session, and how the rows call them."""
    effects, bags = harness.SESSIONS / 'effects', harness.BAGS
    if (effects / 's01.mcap').is_file():
        return effects / 'factory.mcap', effects / 's01.mcap', 'effects/s01'
    return bags / 'factory.mcap', bags / 'moving.mcap', 'bags/moving (own)'


def rows() -> list[harness.Row]:
    """Worst sensor's RMSE and tracked share."""
    scan, bag, name = recordings()
    session = load_session(bag)
    tool = session.tools[0]
    sensors = tool.sensors.name
    topics = {sensor: f'/anser/{topic_of(sensor)}/pose' for sensor in sensors}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'model.yaml'
        save_model(path, harness.calibrated(load_session(scan), layout=None))
        received = replay_through_nodes(
            bag, list(topics.values()), domain=random.randint(1, 100), model=path
        )
        assert load_model(path).positions.size
    nominal = track_session(session, model_for('nominal', session))
    rival = [metrics(nominal.sensors[sensor])['position_rmse_m'] or np.nan for sensor in sensors]
    centres = tool.placed()[0]
    stamps = session.start_ns + np.round(tool.time * 1e9).astype(np.int64)
    rmse, share = [], []
    for column, sensor in enumerate(sensors):
        poses = received[topics[sensor]]
        frames = np.abs(stamps[:, None] - poses.stamp_ns[None]).argmin(axis=0)
        error = np.linalg.norm(poses.position - centres[frames, column], axis=1)
        rmse.append(float(np.sqrt(np.mean(error**2))))
        share.append(np.unique(frames).size / stamps.size)
    return [
        harness.row(
            f'replay {name}: worst sensor, position RMSE',
            1e3 * max(rmse),
            'mm',
            rival=('nominal Biot-Savart model', 1e3 * float(np.nanmax(rival))),
            target=0.25,
        ),
        harness.row(
            f'replay {name}: least tracked share of a sensor',
            100 * min(share),
            '%',
            target=100.0,
            target_is='least',
        ),
    ]
