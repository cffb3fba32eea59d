"""Choices by held-out error: blocks, layouts, the drawn board as a prior, error maps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_world import NOISE_T, scene

from anser_ros.calibration import selection
from anser_ros.calibration.calibrate import Options, best_damped, correct_scan, fit_scan
from anser_ros.calibration.error_map import FEWEST_POINTS, IDENTITY, learn_error_map
from anser_ros.calibration.held_out import rms
from anser_ros.calibration.layout_fit import LayoutPlacer, ScaledNominal
from anser_ros.calibration.layouts import Generator, Layout, place
from anser_ros.calibration.readings import FOLDS, fold_of_frames, thinned
from anser_ros.calibration.selection import DAMPINGS, LayoutCandidate, LayoutScorer, choose_layout
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.settings import Accuracy

SEED = 21
EMITTERS = ('a', 'b', 'c')
TONES = (1000.0, 1100.0, 1200.0)
LAYER = Options(layout=Layout('layer', 10, 1.25, 0.0))
GENERATOR = Generator(np.zeros((1, 3)), np.zeros(1), 0.07)


def calibrate(world, *measurements, options=None, nominal=None):
    """Correct measurements and fit a model to them, as a session's calibration does."""
    options = options or Options()
    names = ('one', 'two')[: len(measurements)]
    generator = replace(world.generator, emitters=EMITTERS, frequencies_hz=TONES, nominal=nominal)
    scan = correct_scan(measurements, generator, options)
    return fit_scan(scan, names, generator, options)


@pytest.fixture(scope='module')
def world():
    return scene(np.random.default_rng(3), side=9)


def inside():
    """Sensors at a hundred places inside the volume: points and axes."""
    rng = np.random.default_rng(9)
    points = rng.uniform([-0.07, -0.07, 0.125], [0.07, 0.07, 0.155], (100, 3))
    return points, np.tile([0.0, 0.6, 0.8], (100, 1))


def drawn(world, gain=1.0):
    return FieldModel(
        world.dipoles.positions, world.dipoles.directions, gain * world.moments, EMITTERS, TONES
    )


def test_a_fold_holds_whole_cells_and_every_frame(rng):
    where = rng.uniform(-0.1, 0.1, (800, 3)) * [1, 1, 0.02]
    folds = fold_of_frames([where[:500], where[500:]])
    both = np.concatenate(folds)
    assert set(both) == set(range(FOLDS))
    assert np.bincount(both).min() > 100
    cell = np.floor((where[:, :2] - where[:, :2].min(axis=0)) / (np.ptp(where, axis=0).max() / 5))
    key = np.minimum(cell, 4) @ [10, 1]
    for value in np.unique(key):
        assert len(set(both[key == value])) == 1


def test_neighbouring_cells_are_of_other_folds_and_one_place_cannot_be_held_out():
    line = np.linspace(0, 1, 25)
    x, y = np.meshgrid(line, line)
    fold = fold_of_frames([np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)])[0]
    lattice = fold.reshape(25, 25)[2::5, 2::5]
    assert (lattice[1:] != lattice[:-1]).all()
    assert (lattice[:, 1:] != lattice[:, :-1]).all()
    with pytest.raises(FitError, match='got 1: all frames are at one place'):
        fold_of_frames([np.zeros((30, 3))])


def test_sessions_on_different_sides_of_a_source_are_held_out_in_parts(rng):
    near = rng.uniform(-0.05, 0.05, (300, 3))
    for fold in fold_of_frames([near, near + [0.5, 0.0, 0.2], near - [0.0, 0.6, 0.0]]):
        assert np.bincount(fold, minlength=FOLDS).min() > 20


def test_layouts_lie_where_they_say():
    generator = Generator(
        np.array([[-0.1, 0, 0.001], [0.1, 0, 0.001]]), np.array([0.0, 45.0]), 0.07
    )
    assert generator.half_extent[0] == pytest.approx((0.2 + 0.035 + 0.0495) / 2, abs=1e-3)
    layer = place(Layout('layer', 4, 1.5, 0.01), generator)
    assert len(layer) == 16
    assert np.ptp(layer.positions[:, 0]) == pytest.approx(3.0 * generator.half_extent[0])
    assert np.allclose(layer.positions[:, 2], -0.009)
    three = place(Layout('layer_xyz', 2, 1.0, 0.0), generator)
    assert len(three) == 12
    assert np.allclose(three.directions[:3], np.eye(3))
    coils = place(Layout('coils', 3, 1.0, 0.0), generator)
    assert len(coils) == 18
    assert np.abs(coils.positions[:9, 0] + 0.1).max() < 0.035
    words = {Layout(k, 3, 1.0, 0.0).describe() for k in ('layer', 'layer_xyz', 'coils')}
    assert len(words) == 3


def test_the_drawn_board_is_expressed_by_any_layer(world):
    board = ScaledNominal(drawn(world), [world.measurements])
    layer = place(Layout('layer', 14, 1.6, 0.0), world.generator)
    model = FieldModel(layer.positions, layer.directions, board.moments(layer), EMITTERS, TONES)
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.1, -0.1, 0.12], [0.1, 0.1, 0.16], (50, 3))
    axes = np.tile([0.0, 0.6, 0.8], (50, 1))
    truth = world.flux(points, axes)
    assert rms(model.flux(points, axes) - truth) < 3e-3 * rms(truth)


def test_the_choice_is_neither_too_coarse_nor_undamped(world):
    thin = thinned([world.measurements], selection.MOST_ROWS)
    folds = fold_of_frames([m.position for m in thin])
    rich = place(Layout('layer', 10, 1.25, 0.0), world.generator)
    placer = LayoutPlacer(world.generator, thin)
    scorer = LayoutScorer(thin, folds, rich, Accuracy(), placer)
    scores = {n: scorer.score(Layout('layer', n, 1.25, 0.0)) for n in (3, 9)}
    assert scores[9].score < 0.5 * scores[3].score
    curve = dict(scores[9].curve)
    assert scores[9].score == min(curve.values())
    assert curve[1e-2] > scores[9].score


@pytest.mark.long
def test_selection_finds_a_prior_and_is_deterministic(world):
    thin = thinned([world.measurements], 300)
    folds = fold_of_frames([m.position for m in thin])
    generator = replace(world.generator, nominal=drawn(world, 0.9))
    runs = [choose_layout(thin, folds, generator, Accuracy()) for _ in range(2)]
    assert runs[0].finalists[0].layout == runs[1].finalists[0].layout
    assert runs[0].finalists[0].layout.prior == 'nominal'
    assert len(runs[0].candidates) > 10


def test_thinning_is_even_and_bounded(world):
    thin = thinned([world.measurements, world.measurements], 200)
    assert sum(m.flux.shape[0] * m.flux.shape[1] for m in thin) <= 212
    assert (np.diff(thin[0].time) == thin[0].time[1]).all()


@pytest.fixture(scope='module')
def calibrated(world):
    return calibrate(world, world.measurements, nominal=drawn(world, 1.02))


@pytest.mark.long
def test_calibration_reaches_the_noise_and_says_so(world, calibrated):
    assert 0.8 * NOISE_T < calibrated.fit.noise_t < 2.5 * NOISE_T
    assert calibrated.model.flux_error_t == calibrated.held_out.flux_error_t < 3 * NOISE_T
    assert calibrated.better_than_nominal
    assert calibrated.model.provenance['sessions'] == ['one']
    points, axes = inside()
    true_error = rms(calibrated.model.flux(points, axes) - world.flux(points, axes))
    assert true_error < 1e-3 * rms(world.flux(points, axes))


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'has_pose': np.zeros(81, dtype=bool)}, 'got 0 of 81'),
        ({'valid': np.arange(81)[:, None] < np.full(6, 4)}, 'at least 10 frames .* got 4'),
        (
            {'position': np.zeros((81, 3)), 'rotation': np.tile(np.eye(3), (81, 1, 1))},
            r'one plane: .* at least 0\.\d+ mm rms, got 0\.00 mm',
        ),
    ],
)
def test_refusals_name_what_is_needed_and_found(world, change, message):
    bad = replace(world.measurements, **change)
    with pytest.raises(FitError, match=message):
        calibrate(world, bad)


def test_more_dipoles_than_readings_are_refused(world):
    few = world.measurements.frames(np.arange(0, 81, 7))
    options = Options(layout=Layout('layer', 12, 1.0, 0.0))
    with pytest.raises(FitError, match=r'144 dipoles need at least 144 readings .* got 72'):
        calibrate(world, few, options=options)
    one = world.measurements.frames(np.arange(0, 81, 7)).sensors_only(np.arange(2))
    with pytest.raises(FitError, match=r'36 dipoles need at least 36 readings .* got 24'):
        calibrate(world, one)
    with pytest.raises(FitError, match='got 0: no session has tool fluxes'):
        calibrate(world)


def test_two_boards_are_told_apart(world):
    other = scene(np.random.default_rng(4), side=9)
    with pytest.raises(FitError, match='different boards'):
        calibrate(world, world.measurements, other.measurements, options=LAYER)


@pytest.mark.long
def test_estimated_sensors_travel_with_the_model(world):
    table = world.measurements.sensors
    gain = np.array([1.01, 0.99, 1.0, 1.02, 0.98, 1.0])
    told = replace(world.measurements, flux=world.measurements.flux * gain[:, None])
    found = calibrate(world, told, options=replace(LAYER, estimate=('gains',)))
    (effect,) = found.model.effects
    assert effect.name == 'sensor_gain_spread'
    assert effect.parameters['channels'] == table.channel.tolist()
    values = np.array(effect.parameters['values'])
    assert np.allclose(values, np.stack([gain, 0 * gain], axis=1), atol=2e-3)


def bent(places):
    return places + 0.003 * np.sin(places / 0.05) + [0.001, -0.002, 0.0]


def test_an_error_map_undoes_a_smooth_error(rng):
    true = rng.uniform(-0.1, 0.1, (120, 3))
    tracked = bent(true) + 1e-4 * rng.normal(size=true.shape)
    found = learn_error_map(tracked, true)
    assert found.helps
    assert found.after.judged < 0.3 * found.before.judged
    fresh = rng.uniform(-0.08, 0.08, (50, 3))
    left = found.apply(bent(fresh)) - fresh
    assert np.sqrt((left**2).sum(axis=1).mean()) < 0.3 * found.before.judged


def test_a_map_of_mere_noise_is_not_used(rng):
    true = rng.uniform(-0.1, 0.1, (60, 3))
    found = learn_error_map(true + 1e-4 * rng.normal(size=true.shape), true)
    assert not found.helps
    assert found.shape == IDENTITY
    assert np.array_equal(found.apply(true), true)
    assert found.after.judged == found.before.judged


@pytest.mark.long
def test_the_error_reported_of_a_map_is_the_error_at_new_places(rng):
    """Whether a map is used is decided without the blocks that its error is reported of."""
    reported, fresh = [], []
    for _ in range(6):
        true = rng.uniform(-0.1, 0.1, (40, 3))
        noise = 1e-3 * rng.normal(size=true.shape)
        found = learn_error_map(true - 0.01 * true + noise, true)
        there = rng.uniform(-0.1, 0.1, (400, 3))
        said = there - 0.01 * there + 1e-3 * rng.normal(size=there.shape)
        reported.append(found.after.judged**2)
        fresh.append(((found.apply(said) - there) ** 2).sum(axis=1).mean())
    assert np.mean(reported) > 0.97 * np.mean(fresh)


def test_a_map_of_points_in_a_plane_is_learnt_in_it(rng):
    true = rng.uniform(-0.1, 0.1, (80, 3)) * [1.0, 1.0, 0.0]
    tracked = true + 0.003 * np.sin(true / 0.05)
    found = learn_error_map(tracked, true)
    assert found.after.judged < 0.3 * found.before.judged
    lifted = tracked + [0.0, 0.0, 0.01]
    assert np.allclose(found.correction(lifted), found.correction(tracked), atol=1e-12)


def test_error_map_refusals():
    with pytest.raises(FitError, match=r'\(n, 3\)'):
        learn_error_map(np.zeros((9, 3)), np.zeros((8, 3)))
    with pytest.raises(FitError, match=f'at least {FEWEST_POINTS} points .* got 7'):
        learn_error_map(np.zeros((7, 3)), np.zeros((7, 3)))


@pytest.mark.parametrize('start', range(len(DAMPINGS)))
@pytest.mark.parametrize('best', [0, 3, len(DAMPINGS) - 1])
def test_the_winner_gets_the_damping_that_its_own_folds_ask_for(start, best):
    layout, tried = Layout('layer', 6, 1.0, 0.0), []

    def tested(candidate):
        tried.append(candidate.damping)
        return SimpleNamespace(score_t=1.0 + abs(DAMPINGS.index(candidate.damping) - best))

    winner = LayoutCandidate(layout, place(layout, GENERATOR), DAMPINGS[start], 1.0, ())
    found, held_out = best_damped(winner, tested(winner), tested)
    assert found.damping == DAMPINGS[best]
    assert held_out.score_t == 1.0
    assert len(tried) == len(set(tried)) <= abs(start - best) + 3


@pytest.mark.parametrize(('gain', 'kind'), [(0.07, 'cluster'), (0.05, 'coaxial')])
def test_emitters_have_any_shape_where_that_gains_more_than_errors_of_sensors_do(gain, kind):
    def score(layout):
        own = 1.0 if layout.kind == 'cluster' else 1.0 + gain
        return LayoutCandidate(layout, None, DAMPINGS[0], own, ())

    search = selection._Search(SimpleNamespace(score=score), GENERATOR, None)
    assert search.other_finalists()[0].layout.kind == kind
