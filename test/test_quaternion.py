"""Quaternions that come from outside: rounded ones are mended, other numbers are none."""

import numpy as np

from anser_ros.wire.recorded import unit_quaternions


def test_rounded_ones_are_brought_to_unit_length():
    true = np.random.default_rng(1).normal(size=(200, 4))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    mended = unit_quaternions(np.round(true, 2))
    np.testing.assert_allclose(np.linalg.norm(mended, axis=1), 1.0, rtol=1e-12)
    assert np.abs(mended - true).max() < 0.011


def test_other_numbers_are_none():
    given = [[0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0], [10.0, 20.0, 30.0, 0.0]]
    assert np.isnan(unit_quaternions(given)).all()
