"""Dipole positions by variable projection."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_world import scene

from anser_ros.calibration.least_squares import as_complex
from anser_ros.calibration.placement import PositionFitter, position_slopes
from anser_ros.calibration.readings import DipoleSites, usable_weights
from anser_ros.physics.dipole import flux_basis

SEED = 8


@pytest.mark.parametrize('length', [0.0, 0.008])
def test_position_slopes_are_differences(rng, length):
    world = scene(rng, side=2)
    points = rng.uniform([-0.1, -0.1, 0.1], [0.1, 0.1, 0.2], (6, 3))
    axes = rng.normal(size=(6, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    lengths = np.full(6, length)
    slopes = position_slopes(points, axes, lengths, world.dipoles)
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        up, down = (
            flux_basis(
                points, axes, lengths, world.dipoles.positions + s, world.dipoles.directions
            )
            for s in (step, -step)
        )
        assert np.allclose(slopes[..., i], (up - down) / 2e-6, rtol=1e-5, atol=1e-12)


def test_displaced_dipoles_find_back(rng):
    world = scene(rng, jitter=0.0, noise=1e-14)
    rows = np.arange(0, 21, 7)
    few = DipoleSites(world.dipoles.positions[rows], world.dipoles.directions[rows])
    flux = flux_basis(
        *(a.reshape(-1, 3) for a in world.measurements.placed()), None,
        few.positions, few.directions,
    ) @ world.moments[rows]  # fmt: skip
    measured = replace(world.measurements, flux=flux.reshape(world.measurements.flux.shape))
    start = DipoleSites(few.positions + rng.uniform(-0.01, 0.01, (3, 3)), few.directions)
    fitter = PositionFitter([measured], [usable_weights(measured)], start, 0.0)
    found = fitter.fit(most_steps=40)
    assert np.abs(found.positions - few.positions).max() < 1e-5
    moments, cost = fitter.solve(found)
    assert np.allclose(as_complex(moments), world.moments[rows], rtol=1e-3, atol=1e-6)
    assert cost < 1e-6 * fitter.solve(start)[1]
