"""Coils that lie beside their drawing are found where they are, and hold beyond the readings."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_world import scene
from scipy.spatial.transform import Rotation

from anser_ros.calibration.held_out import rms
from anser_ros.calibration.layout_fit import LayoutFitter, LayoutPlacer, ScaledNominal, rich_layout
from anser_ros.calibration.layouts import Layout, place
from anser_ros.calibration.least_squares import as_complex
from anser_ros.calibration.placement import CoilPlacer, PositionFitter, position_slopes
from anser_ros.calibration.readings import DipoleSites, fold_of_frames, usable_weights
from anser_ros.calibration.selection import LayoutScorer
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis
from anser_ros.settings import Accuracy

SHIFT = np.array([[0.8e-3, -0.3e-3, 0.4e-3], [-0.5e-3, 0.2e-3, -0.6e-3], [0.1e-3, 0.7e-3, 0.3e-3]])
TURN = np.array([[8e-3, -4e-3, 20e-3], [-6e-3, 2e-3, -10e-3], [3e-3, 9e-3, 5e-3]])
GAIN = np.array([1.01, 0.98 * np.exp(1e-3j), 1.0])


@pytest.fixture(scope='module')
def world():
    return scene(np.random.default_rng(31), side=9)


@pytest.fixture(scope='module')
def drawing(world):
    """What would be drawn of the world if its coils had been shifted, turned and wound wrongly."""
    positions, directions = world.dipoles.positions.copy(), world.dipoles.directions.copy()
    for k in range(3):
        rows, turn = slice(7 * k, 7 * k + 7), Rotation.from_rotvec(TURN[k]).as_matrix()
        middle = positions[rows].mean(axis=0)
        positions[rows] = (positions[rows] - middle) @ turn + middle - SHIFT[k]
        directions[rows] = directions[rows] @ turn
    return FieldModel(
        positions, directions, world.moments / GAIN, ('a', 'b', 'c'), (1000.0, 1100.0, 1200.0)
    )


def sharp(world):
    """The world's readings at their true poses."""
    return replace(world.measurements, position=world.position, rotation=world.rotation)


def below(world):
    """Points 5 cm below the lowest reading, their axes, and the true flux there."""
    points = np.random.default_rng(4).uniform([-0.08, -0.08, 0.05], [0.08, 0.08, 0.07], (80, 3))
    axes = np.tile([0.0, 0.6, 0.8], (80, 1))
    return points, axes, world.flux(points, axes)


def test_coils_are_found_where_they_lie(world, drawing):
    told = sharp(world)
    sites, moments = CoilPlacer(drawing).fit([told], [np.ones(told.flux.shape[:2])])
    assert np.abs(sites.positions - world.dipoles.positions).max() < 0.1e-3
    assert np.abs(sites.positions - drawing.positions).max() > 0.7e-3
    assert np.allclose(moments[world.moments != 0], world.moments[world.moments != 0], rtol=2e-3)


def test_placed_coils_hold_where_nothing_was_read(world, drawing):
    told, (points, axes, truth) = sharp(world), below(world)
    sites, moments = CoilPlacer(drawing).fit([told], [np.ones(told.flux.shape[:2])])
    found = FieldModel(
        sites.positions, sites.directions, moments, drawing.emitters, drawing.frequencies_hz
    )
    gains = ScaledNominal(drawing, [told]).gains
    assert rms(found.flux(points, axes) - truth) < 0.05 * rms(
        drawing.flux(points, axes) * gains - truth
    )


def test_readings_that_tell_nothing_leave_coils_as_drawn(world, drawing):
    few = sharp(world).frames(np.arange(2))
    sites, _ = CoilPlacer(drawing).fit([few], [np.ones(few.flux.shape[:2])])
    assert np.abs(sites.positions - drawing.positions).max() < 5e-3


def test_dipoles_of_several_emitters_are_no_coils(drawing):
    assert CoilPlacer(drawing).possible
    shared = replace(drawing, moments=drawing.moments + 1e-6)
    assert not CoilPlacer(shared).possible


def test_held_out_blocks_choose_placed_coils(world, drawing):
    told = [world.measurements]
    generator = replace(world.generator, nominal=drawing)
    scorer = LayoutScorer(
        told, fold_of_frames([world.measurements.position]),
        place(rich_layout(told, generator), generator), Accuracy(),
        LayoutPlacer(generator, told),
    )  # fmt: skip
    coils = Layout('drawing', 21, 1.0, 0.0, 'nominal', True)
    still = Layout('layer', 10, 1.25, 0.0, 'nominal')
    scores = [scorer.score(layout).score for layout in (coils, still)]
    assert scores[0] < 0.7 * scores[1]
    whole = LayoutFitter(told, generator, Accuracy()).fit(coils, 1e-2)
    points, axes, truth = below(world)
    model = FieldModel(
        whole.dipoles.positions, whole.dipoles.directions, whole.fit.moments, drawing.emitters,
        drawing.frequencies_hz,
    )  # fmt: skip
    assert rms(model.flux(points, axes) - truth) < 2e-3 * rms(truth)


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
