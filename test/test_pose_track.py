"""Poses between those of an optical track: a hand's path lies outside its chords."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anser_ros.physics.pose_track import LONGEST_GAP_S, PoseTrack

WAVES = ((0.9, 0.0), (1.3, 1.0), (1.7, 2.0))
REFLECTED = 150


def position(time):
    """A hand's path, m."""
    return 0.09 * np.stack([np.sin(w * time + p) for w, p in WAVES], axis=1)


def turn(time):
    """Its turns."""
    return Rotation.from_rotvec(6.0 * position(time))


def track(rate_hz, flip=False):
    """The path as a camera without jitter sees it for 10 s; quaternions may change their sign."""
    time = np.arange(0.0, 10.0, 1.0 / rate_hz)
    quaternion = turn(time).as_quat()
    if flip:
        quaternion[::7] *= -1.0
    return PoseTrack(time, position(time), quaternion)


def chords(told, time):
    """The same between two poses each, as numpy interpolates."""
    return np.stack([np.interp(time, told.time, p) for p in told.position.T], axis=1)


@pytest.mark.parametrize('flip', [False, True])
def test_a_path_is_followed_outside_its_chords(flip):
    told, time = track(60.0, flip), np.arange(0.5, 9.0, 0.04)
    there, turned, valid = told.at(time)
    assert valid.all()
    beside = np.abs(chords(told, time) - position(time)).max()
    assert beside > 5e-6
    assert np.abs(there - position(time)).max() < 0.01 * beside
    errors = (Rotation.from_matrix(turned) * turn(time).inv()).magnitude()
    assert errors.max() < 0.02 * 6.0 * beside


def test_a_reflected_pose_bends_only_what_it_bounds():
    told, time = track(60.0), np.arange(0.5, 9.0, 0.04)
    clean = told.at(time)[0]
    wrong = told.position.copy()
    wrong[REFLECTED] += [0.02, -0.01, 0.015]
    found = PoseTrack(told.time, wrong, told.quaternion).at(time)[0]
    beside = np.abs(time - told.time[REFLECTED]) > 1.0 / 60.0
    assert np.abs(found - clean)[beside].max() < 5e-6
    assert np.abs(found - clean)[~beside].max() > 1e-3


def test_jitter_grows_little():
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 60.0, 1.0 / 60.0)
    told = PoseTrack(
        time, rng.normal(size=(time.size, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (3600, 1))
    )
    at = np.arange(1.0, 59.0, 0.04)
    assert told.at(at)[0].std() < 1.03 * chords(told, at).std()


@pytest.mark.parametrize('rate_hz', [5.0, 20.0])
def test_a_track_too_slow_to_tell_its_curvature_keeps_the_chord(rate_hz):
    told, time = track(rate_hz), np.arange(0.5, 9.0, 0.04)
    assert 9.0 / rate_hz > LONGEST_GAP_S
    assert np.array_equal(told.at(time)[0], chords(told, time))
