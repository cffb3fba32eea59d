"""The bound on what few references could know: its derivatives, and what more knowledge does."""

import sys

import numpy as np
import pytest
from conftest import REPO
from refit_world import anser_world

sys.path.append(str(REPO / 'test' / 'bench'))

from bench_bound import marginal
from bound_block import Block, block_points

from anser_ros.refit.clouds import excitation_for

PLACE = np.array([0.02, -0.01, -0.05, 0.05, -0.02, 0.1])


@pytest.fixture(scope='module')
def scene():
    world = anser_world(4)
    excitation, _ = excitation_for(world.model, world.board.field)
    tilt = np.log(world.model.frequencies_hz) - np.log(world.model.frequencies_hz).mean()
    answer = np.random.default_rng(3).standard_normal((len(block_points()), 2)) @ [0.4, 0.2j] - 0.6
    table = world.references
    return excitation, tilt, answer, (table.position, table.axis, table.length), world.model


def test_derivatives_by_answers_are_those_of_the_readings(scene):
    excitation, tilt, answer, coils, _ = scene
    columns = Block(answer, tilt).columns(PLACE, excitation, *coils)
    n, step = len(answer), 1e-4
    for point in (0, 70, n - 1):
        for kind, direction in ((0, step), (n, 1j * step)):
            moved = [
                Block(answer + sign * direction * np.eye(n)[point], tilt).read(
                    PLACE, excitation, *coils
                )
                for sign in (1.0, -1.0)
            ]
            wanted = (moved[0] - moved[1]).ravel() / (2.0 * step)
            off = np.abs(columns[:, kind + point] - wanted).max()
            assert off < 1e-6 * np.abs(wanted).max()


def test_what_is_open_besides_only_takes_information_away():
    rows = np.random.default_rng(1).standard_normal((40, 9))
    whole = rows.T @ rows
    left = whole[:5, :5] - marginal(whole, 5)
    assert np.trace(left) > 1.0
    joint = np.linalg.inv(whole + np.diag([0.0] * 5 + [1.0] * 4))[:5, :5]
    np.testing.assert_allclose(np.linalg.inv(marginal(whole, 5)), joint)
