"""Moments at poses that jitter, and coils that lie beside their drawing."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_world import JITTER_M, JITTER_RAD, NOISE_T, scene
from scipy.spatial.transform import Rotation

from anser_ros.calibration.drawn_fit import drawn_where_read, is_of_coils
from anser_ros.calibration.held_out import rms
from anser_ros.calibration.layout_fit import LayoutFitter, LayoutPlacer, ScaledNominal, rich_layout
from anser_ros.calibration.layouts import Layout, place
from anser_ros.calibration.least_squares import GramFactor, TriangularFactor
from anser_ros.calibration.moments import (
    MomentFitter,
    PoseWhitener,
    most_probable_step,
    moved,
    pose_precision,
    pose_terms,
)
from anser_ros.calibration.readings import fold_of_frames, usable_weights, with_pose
from anser_ros.calibration.selection import LayoutScorer
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis
from anser_ros.settings import Accuracy

SEED = 5
LAYER = Layout('layer', 9, 1.3, 0.0)


@pytest.fixture
def rows(rng):
    return rng.normal(size=(60, 7)) * 10.0 ** rng.uniform(-8, -4, 7), rng.normal(
        size=(60, 4)
    ) * 1e-9


@pytest.mark.parametrize('kind', [TriangularFactor, GramFactor])
@pytest.mark.parametrize('blocks', [[60], [1, 59], [20, 20, 20], [7, 53]])
def test_factor_is_least_squares_whatever_the_blocks(rows, kind, blocks):
    matrix, right = rows
    factor = kind(7, 4)
    for part in np.split(np.arange(60), np.cumsum(blocks)[:-1]):
        factor.add(matrix[part], right[part])
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert np.allclose(factor.spectrum().solve(0.0), expected, rtol=1e-6)
    assert factor.spectrum().rank == 7


@pytest.mark.parametrize('kind', [TriangularFactor, GramFactor])
def test_damping_and_prior_are_further_rows(rows, rng, kind):
    matrix, right = rows
    factor = kind(7, 4)
    factor.add(matrix, right)
    spectrum = factor.spectrum()
    prior = rng.normal(size=(7, 4)) / np.linalg.norm(matrix, axis=0)[:, None] * 1e-9
    ridge = 0.3 * spectrum.values[0] * np.diag(np.linalg.norm(matrix, axis=0))
    expected = np.linalg.lstsq(
        np.vstack([matrix, ridge]), np.vstack([right, ridge @ prior]), rcond=None
    )[0]
    assert np.allclose(spectrum.solve(0.3, prior), expected, rtol=1e-6)
    assert 0 < spectrum.freedom(0.3) < spectrum.freedom(0.0) == pytest.approx(7)


def test_a_column_of_zeros_is_left_out(rows):
    matrix, right = rows
    matrix = np.hstack([matrix, np.zeros((60, 1))])
    factor = TriangularFactor(8, 4)
    factor.add(matrix, right)
    spectrum = factor.spectrum()
    assert spectrum.rank == 7
    assert np.all(spectrum.solve(0.0)[7] == 0)


def test_pose_slopes_are_differences(rng):
    world = scene(rng, side=3)
    terms = pose_terms(world.measurements, world.dipoles, world.moments)
    for parameter in range(6):
        step = np.zeros((len(world.measurements.time), 6))
        step[:, parameter] = 1e-6
        up, down = (
            pose_terms(moved(world.measurements, s), world.dipoles, world.moments).residual
            for s in (step, -step)
        )
        slope = -(up - down) / 2e-6  # the residual is measured minus modelled
        assert np.allclose(terms.slope[..., parameter], slope, atol=1e-6 * np.abs(slope).max())


def test_step_finds_the_jitter(rng):
    world = scene(rng)
    terms = pose_terms(world.measurements, world.dipoles, world.moments)
    weights = usable_weights(world.measurements)
    step, left = most_probable_step(terms, weights, NOISE_T, pose_precision(Accuracy()))
    truth = world.position - world.measurements.position
    assert truth.std() > 0.9 * JITTER_M
    assert (step[:, :3] - truth).std() < 0.1 * JITTER_M
    turned = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ world.measurements.rotation
    assert (turned - world.rotation).std() < 0.2 * JITTER_RAD
    assert left.std() == pytest.approx(NOISE_T, rel=0.2)


def field_error(world, model_flux):
    points = np.random.default_rng(1).uniform([-0.08, -0.08, 0.12], [0.08, 0.08, 0.16], (200, 3))
    axes = np.tile(np.eye(3), (67, 1))[:200]
    return np.abs(model_flux(points, axes) - world.flux(points, axes)).std()


def fitted(world, damping=0.0, **options):
    dipoles = world.dipoles
    fitter = MomentFitter([world.measurements], dipoles, damping, Accuracy())

    def flux(moments):
        return lambda points, axes: (
            flux_basis(points, axes, None, dipoles.positions, dipoles.directions) @ moments
        )

    plain = flux(fitter.solve()[0])
    fit = fitter.fit(**options)
    return fit, plain, flux(fit.moments)


def test_corrected_poses_give_a_better_field_and_the_noise(rng):
    world = scene(rng, side=9)
    fit, plain, corrected = fitted(world, alternations=12)
    assert field_error(world, corrected) < 0.95 * field_error(world, plain)
    assert 0.9 * NOISE_T < fit.noise_t < 2 * NOISE_T
    assert fit.rank == len(world.dipoles)
    assert fit.alternations >= 2


def test_gross_outliers_lose_their_weight(rng):
    world = scene(rng, side=9)
    clean = field_error(world, fitted(world)[2])
    flux = world.measurements.flux.copy()
    bad = rng.choice(len(flux), 4, replace=False)
    flux[bad] = flux[bad[::-1]]
    flux[bad[0] + 1, 2] += 1e-7
    spoilt = replace(world, measurements=replace(world.measurements, flux=flux))
    fit, plain, robust = fitted(spoilt, alternations=12)
    assert field_error(world, plain) > 50 * clean
    assert field_error(world, robust) < 3 * clean
    assert fit.weights[0][bad].max() < 0.1
    assert fit.weights[0][bad[0] + 1, 2] < 0.1


def test_predictive_chi_square_is_one_at_the_truth(rng):
    world = scene(rng, side=12)
    terms = pose_terms(world.measurements, world.dipoles, world.moments)
    weights = usable_weights(world.measurements)
    white = PoseWhitener(terms.slope, weights, NOISE_T, pose_precision(Accuracy()))
    each = white.chi_square(terms.residual) / terms.residual[0].size
    assert each.mean() == pytest.approx(1.0, abs=0.05)
    assert abs(np.mean(white.excess_power(terms.residual))) < (0.3 * NOISE_T) ** 2
    error = 60e-12 * np.random.default_rng(2).normal(size=terms.residual.shape)
    found = np.sqrt(np.median(white.excess_power(terms.residual + error)))
    assert found == pytest.approx(60e-12, rel=0.1)


def test_readings_without_pose_are_left_out(rng):
    world = scene(rng, side=4)
    m = world.measurements
    has_pose = m.has_pose.copy()
    has_pose[:3] = False
    part = with_pose(replace(m, has_pose=has_pose))
    assert len(part.time) == 13
    nothing = replace(m, has_pose=np.zeros(16, dtype=bool))
    with pytest.raises(FitError, match='no reading has a pose'):
        MomentFitter([nothing], place(LAYER, world.generator), 1e-6, Accuracy())


def test_a_fit_starts_where_another_one_ended(rng):
    world = scene(rng)
    layer = place(LAYER, world.generator)
    first = MomentFitter([world.measurements], layer, 1e-4, Accuracy())
    found = first.fit(exact=False)
    offsets = first.states[0].offset.copy()
    other = MomentFitter([world.measurements], layer, 1e-4, Accuracy())
    other.start_at(first)
    moments, spectra = other.solve(exact=False)
    assert np.allclose(moments, found.moments, rtol=1e-9, atol=0.0)
    assert other.noise_t == first.noise_t
    other.correct(moments, other.freedom(spectra))
    assert np.array_equal(first.states[0].offset, offsets)
    assert not np.array_equal(other.states[0].offset, offsets)


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


def placed(world, drawing, told):
    return drawn_where_read([told], replace(world.generator, nominal=drawing))


def test_coils_are_found_where_they_lie(world, drawing):
    found = placed(world, drawing, sharp(world))
    assert np.abs(found.positions - world.dipoles.positions).max() < 0.1e-3
    assert np.abs(found.positions - drawing.positions).max() > 0.7e-3
    moments = found.moments[world.moments != 0]
    assert np.allclose(moments, world.moments[world.moments != 0], rtol=2e-3)


def test_placed_coils_hold_where_nothing_was_read(world, drawing):
    told, (points, axes, truth) = sharp(world), below(world)
    found = placed(world, drawing, told)
    scaled = ScaledNominal(drawing, [told]).nominal
    assert rms(found.flux(points, axes, None) - truth) < 0.05 * rms(
        scaled.flux(points, axes) - truth
    )


def test_readings_that_tell_nothing_leave_coils_as_drawn(world, drawing):
    found = placed(world, drawing, sharp(world).frames(np.arange(2)))
    assert np.abs(found.positions - drawing.positions).max() < 5e-3


def test_dipoles_of_several_emitters_are_no_coils(drawing):
    assert is_of_coils(drawing)
    assert not is_of_coils(replace(drawing, moments=drawing.moments + 1e-6))


def test_held_out_blocks_choose_placed_coils(world, drawing):
    told = [world.measurements]
    # A drawing says nothing of a current that nobody measured.
    driven = replace(drawing, moments=-1.7 * drawing.moments)
    generator = replace(world.generator, nominal=driven)
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
