"""Angles of axes and rotations against those that made them, from tiny to half a turn."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anser_ros.physics.rotations import axis_angles, rotation_angles

ANGLES = np.array([0.0, 1e-12, 1e-6, 0.3, 1.5, np.pi - 1e-6, np.pi])


@pytest.fixture
def turns():
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(ANGLES.size, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True) * ANGLES[:, None]


def test_the_angle_of_a_rotation_is_that_which_made_it(turns):
    matrices = Rotation.from_rotvec(turns).as_matrix()
    np.testing.assert_allclose(rotation_angles(matrices), ANGLES, rtol=1e-9, atol=1e-15)
    assert rotation_angles(matrices[3]) == pytest.approx(0.3, rel=1e-12)
    assert np.isnan(rotation_angles(np.full((3, 3), np.nan)))


def test_the_angle_between_axes_is_that_of_the_turn_across_them(turns):
    rng = np.random.default_rng(2)
    first = np.cross(np.where(ANGLES[:, None] > 0, turns, 1.0), rng.normal(size=turns.shape))
    second = 3.0 * Rotation.from_rotvec(turns).apply(first)
    # Turned axes are rounded to 1e-16 of their length, and so are angles.
    np.testing.assert_allclose(axis_angles(first, second), ANGLES, rtol=1e-9, atol=1e-15)
    assert np.isnan(axis_angles(first[0], np.full(3, np.nan)))
