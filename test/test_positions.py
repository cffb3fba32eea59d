"""Dipole positions by variable projection, and sensors surveyed with the field."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_world import scene

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.positions import PositionFitter, position_slopes
from anser_ros.calibration.readings import usable_weights
from anser_ros.calibration.sensor_parameters import tangents
from anser_ros.calibration.sensor_survey import SensorSurveyor
from anser_ros.physics.dipole import flux_basis
from anser_ros.settings import Accuracy


@pytest.fixture
def rng():
    return np.random.default_rng(8)


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
    fit = PositionFitter([measured], [usable_weights(measured)], start, 0.0).fit(most_steps=40)
    assert fit.end_t < 1e-3 * fit.start_t
    assert np.abs(fit.dipoles.positions - few.positions).max() < 1e-5
    assert np.allclose(fit.moments, world.moments[rows], rtol=1e-3, atol=1e-6)
    assert fit.steps <= 40


def test_tangents_are_across(rng):
    axes = rng.normal(size=(5, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    pair = tangents(axes)
    assert np.allclose(np.einsum('stj,sj->st', pair, axes), 0)
    assert np.allclose(np.einsum('stj,suj->stu', pair, pair), np.eye(2))


def test_gains_axes_and_lever_arm_are_found(rng):
    world = scene(rng, side=14)
    table = world.measurements.sensors
    gain = 1 + 0.01 * rng.normal(size=6) + 0.01j * rng.normal(size=6)
    gain /= np.median(np.abs(gain)) * np.exp(1j * np.median(np.angle(gain)))
    tilt = 0.01 * rng.normal(size=(6, 2))
    wrong = table.axis + np.einsum('st,stj->sj', tilt, tangents(table.axis))
    wrong /= np.linalg.norm(wrong, axis=1)[:, None]
    told = replace(
        world.measurements,
        flux=world.measurements.flux * gain[:, None],
        sensors=table.with_geometry(axis=wrong),
    )
    surveyor = SensorSurveyor([told], ('gains', 'axes'), world.generator, Accuracy())
    found = surveyor.fit()['tool']
    assert np.abs(found.gain - gain).max() < 1e-3
    off = np.linalg.norm(np.cross(found.axis, table.axis), axis=1)
    assert off.max() < 1e-3 < np.linalg.norm(np.cross(wrong, table.axis), axis=1).max()
    assert [record.name for record in found.records] == ['sensor_gain'] * 6 + ['sensor_axis'] * 6
    repaired = found.apply(told)
    assert np.allclose(repaired.flux, world.measurements.flux, rtol=2e-3)


def test_a_lever_arm_shows_when_the_tool_turns(rng):
    world = scene(rng, side=10)
    turned = replace(
        world.measurements, sensors=world.measurements.sensors.with_geometry(
            position=world.measurements.sensors.position - [0.0, 0.0, 0.004]
        ),
    )  # fmt: skip
    surveyor = SensorSurveyor([turned], ('lever_arm',), world.generator, Accuracy())
    found = surveyor.fit()['tool']
    sigma = np.array(found.records[0].uncertainty['offset_m'])
    assert found.records[0].name == 'lever_arm'
    assert (np.abs(found.offset - [0.0, 0.0, 0.004]) < np.maximum(5 * sigma, 1e-3)).all()
