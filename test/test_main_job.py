"""The main job: a session replayed through the real nodes over DDS gives the right poses."""

import os
from pathlib import Path

import numpy as np
from chain import replay_through_nodes
from shortened import beginning

from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import track_session
from anser_ros.wire.setup import topic_of

BAGS = Path(__file__).resolve().parents[1] / 'bags'


def compare(bag: Path, model: Path, alike_m: tuple[float, float] = (1e-8, 2e-5)) -> None:
    """Poses over DDS are those of the offline evaluation, and as good as the reference.

    ``alike_m`` is how far they are apart at most: the median, and all.
    """
    session = load_session(bag)
    tool = session.tools[0]
    topics = {name: f'/anser/{topic_of(name)}/pose' for name in (*tool.sensors.name, tool.body)}
    received = replay_through_nodes(
        bag, list(topics.values()), domain=int(os.environ['ROS_DOMAIN_ID']), model=model
    )
    offline = track_session(session, load_model(model))
    centres, axes = tool.placed()
    stamps = session.start_ns + np.round(tool.time * 1e9).astype(np.int64)
    for column, name in enumerate(tool.sensors.name):
        live = received[topics[name]]
        frames = np.searchsorted(stamps, live.stamp_ns)
        np.testing.assert_array_equal(np.abs(stamps[frames] - live.stamp_ns) < 2, True)
        assert np.unique(frames).size == frames.size >= 0.99 * stamps.size
        known = tool.has_pose[frames]
        assert known.mean() > 0.99
        error = np.linalg.norm(live.position - centres[frames, column], axis=1)[known]
        assert np.sqrt(np.mean(error**2)) < 0.25e-3
        turn = np.linalg.norm(np.cross(live.axis, axes[frames, column]), axis=1)[known]
        assert np.sqrt(np.mean(turn**2)) < np.radians(0.15)
        estimates = offline.sensors[name].estimates
        same = np.array([estimates[frame].position for frame in frames])
        # The nodes' first frames may start before a model's uncertainty has arrived.
        assert np.median(np.abs(live.position - same)) < alike_m[0]
        assert np.abs(live.position - same).max() < alike_m[1]


def test_our_own_bag(domain, factory_calibration):
    compare(BAGS / 'moving.mcap', factory_calibration / 'model.yaml')


def test_a_session_that_this_package_did_not_make(domain, shared, effects_model, tmp_path):
    """Its first ten seconds, in which the tool crosses the whole width of the volume.

    At the edges the model errs as if an emitter were stronger by a thousandth. What tools learn of
    that depends on the frame that they begin with.
    """
    bag = shared / 'sessions' / 'effects' / 's01.mcap'
    begun = beginning(bag, tmp_path / 'begin.mcap', 10.0)
    compare(begun, effects_model, alike_m=(1e-5, 2e-4))
