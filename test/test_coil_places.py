"""Coils that lie beside their drawing are found where they are, and hold beyond the readings."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_world import scene
from scipy.spatial.transform import Rotation

from anser_ros.calibration.held_out import rms
from anser_ros.calibration.layout_fit import LayoutFitter, LayoutPlacer, ScaledNominal, rich_layout
from anser_ros.calibration.layouts import Layout, place
from anser_ros.calibration.placement import CoilPlacer
from anser_ros.calibration.readings import fold_of_frames
from anser_ros.calibration.selection import LayoutScorer
from anser_ros.field.model import FieldModel
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
