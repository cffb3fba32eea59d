"""The live refit: what it corrects, what it leaves alone, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from refit_world import (
    HEAD,
    NOISE_T,
    STEP_NS,
    anser_world,
    errors,
    metal_block,
    replace_geometry,
    rms,
    run,
    share_left,
    three_coil_world,
    volume_points,
)

from anser_ros.errors import FitError
from anser_ros.frames.intake import Intake
from anser_ros.integrity.clean_references import check_steady
from anser_ros.refit.frame import ReadingWindow
from anser_ros.refit.live_refit import LiveRefit

# The refit that all share takes some five seconds to work out.
pytestmark = [pytest.mark.usefixtures('shared_tables'), pytest.mark.long]


def test_nothing_changed_leaves_the_calibrated_model_itself(refit):
    world = anser_world()
    for frame in range(40):
        result = run(refit, world, 0.0, frames=1, seed=frame, start=1 + frame)
        assert result.model is world.model
        assert (result.state, result.left_out) == ('frozen', ())
        assert result.metal is None
    assert result.noise_t == pytest.approx(NOISE_T, rel=0.15)


def test_metal_is_seen_at_once_and_its_field_is_taken_off(refit):
    world = anser_world()
    run(refit, world, 0.0)
    result = run(refit, world, world.metal(HEAD), frames=1, start=10)
    assert result.state == 'refit'
    assert result.log_odds > 10
    before, after, _, _ = errors(world, result.model, HEAD)
    assert before > 1e-9
    assert after < 0.03 * before
    centre = HEAD.mean(axis=0)
    assert np.linalg.norm(result.metal.centroid - centre) < 0.06
    assert result.metal.polarisability.shape == (len(result.metal.positions),)
    # When it has gone, the model is the calibrated one again.
    result = run(refit, world, 0.0, frames=3, start=20)
    assert result.model is world.model


def test_far_metal_is_corrected_too_and_the_uncertainty_is_honest(refit):
    world = anser_world()
    for depth in (0.2, 0.12, 0.06):
        points = metal_block([-0.04, 0.03, -depth - 0.02], [0.08, 0.08, 0.04])
        result = run(refit, world, world.metal(points), frames=12, start=1 + int(1e4 * depth))
        before, after, sigma, error = errors(world, result.model, points)
        assert after < 0.1 * before
        score = np.abs(error) / sigma
        assert np.sqrt(np.mean(score**2)) < 2.5
        assert np.mean(sigma) < 0.5 * before


def test_metal_over_the_volume(refit):
    world = anser_world()
    points = metal_block([0.02, 0.01, 0.36], [0.25, 0.2, 0.04])
    result = run(refit, world, world.metal(points, polarisability=-15000.0), frames=6)
    before, after, _, _ = errors(world, result.model, points, -15000.0)
    assert not max(result.weights, key=result.weights.get).startswith(('nothing', 'below'))
    assert after < 0.1 * before


def test_an_emitter_that_drifts_is_followed_without_inventing_metal(refit):
    world = anser_world()
    drift = np.zeros(8, complex)
    drift[4] = 0.004 - 0.001j
    run(refit, world, 0.0)
    result = run(refit, world, world.baseline * drift, frames=8, start=10)
    assert result.state == 'refit'
    assert abs(result.drift[4] - drift[4]) < 2e-4
    places, axes = volume_points()
    clean = world.model.flux(places, axes)
    np.testing.assert_allclose(
        result.model.flux(places, axes), clean * (1 + drift), atol=0.03 * rms(clean * drift)
    )


def test_a_drift_of_all_emitters_may_be_the_references_own_gain_that_moves_no_tool(refit):
    world = anser_world()
    for step in range(40):
        result = run(refit, world, 1.5e-3 * step * world.baseline, frames=1, start=1 + step)
    assert np.abs(result.drift - 0.06).max() < 5e-3
    assert result.weights['nothing'] > 0.9
    _, _, sigma, error = errors(world, result.model, HEAD, 0.0)
    assert 0.9 < np.sqrt(np.mean((np.abs(error) / sigma) ** 2)) < 1.5


def window_of(world, change, frames=12):
    window = ReadingWindow(world.references, 8, 10.0)
    intake = Intake(world.references.channel)
    rng = np.random.default_rng(4)
    for frame in range(frames):
        flux = world.baseline + change(frame / frames) + world.noise(rng)
        window.add(intake.judge(1 + frame, world.references.channel, flux))
    return window


def test_no_baseline_is_taken_while_metal_moves():
    world = anser_world()
    metal = world.metal(HEAD)
    weaker = -1e-3 * np.arange(8) * world.baseline  # emitters that drift are no metal
    for steady in (lambda share: 0.0, lambda share: metal, lambda share: share * weaker):
        assert check_steady(window_of(world, steady).frames) < NOISE_T
    with pytest.raises(FitError, match='is metal moving'):
        check_steady(window_of(world, lambda share: share * metal).frames)


@pytest.mark.long
def test_any_number_of_emitters():
    world = three_coil_world()
    points = metal_block([0.01, 0.02, -0.08], [0.06, 0.06, 0.03])
    refit = world.refit()
    result = run(refit, world, world.metal(points), frames=4)
    places = volume_points()[0] * [0.7, 0.7, 0.8]
    axes = volume_points()[1]
    tools = replace_geometry(world.references, places, axes)
    truth = world.metal(points, tools)
    made = result.model.flux(places, axes) - world.model.flux(places, axes)
    assert rms(truth - made) < 0.05 * rms(truth)


@pytest.mark.long
def test_phases_of_the_emitters_are_turned_back():
    world = anser_world()
    turn = np.exp(1j * np.linspace(0.2, 0.9, 8))
    model = replace(world.model, moments=world.model.moments * turn)
    refit = LiveRefit(model, world.references, world.baseline * turn, drawing=world.board.field)
    rng = np.random.default_rng(3)
    flux = (world.baseline + world.metal(HEAD)) * turn + world.noise(rng)
    result = refit.update(STEP_NS, world.references.channel, flux)
    places, axes = volume_points()
    truth = world.metal(HEAD, replace_geometry(world.references, places, axes)) * turn
    made = result.model.flux(places, axes) - model.flux(places, axes)
    assert rms(truth - made) < 0.03 * rms(truth)


@pytest.mark.long
def test_a_drawing_of_another_board_is_not_believed(refit):
    world, other = anser_world(), three_coil_world()
    assert refit._tables.excitation.source == 'board'

    def shuffled(points):
        return world.board.field(points)[:, ::-1]

    few = anser_world(8)
    other_way = LiveRefit(few.model, few.references, few.baseline, drawing=shuffled)
    assert other_way._tables.excitation.source == 'model'
    result = run(other_way, few, few.metal(HEAD))
    assert share_left(few, result.model, HEAD) < 0.3
    with pytest.raises(FitError, match='the drawing makes fields'):
        LiveRefit(world.model, world.references, world.baseline, drawing=other.board.field)


def test_a_change_that_nothing_explains_is_a_state_not_a_confident_model(refit):
    world, rng = anser_world(), np.random.default_rng(8)
    strange = 0.4 * world.baseline * rng.normal(size=world.baseline.shape)
    result = run(refit, world, strange)
    assert result.model.flux_error_t > 500 * NOISE_T


def test_what_does_not_fit_is_refused(refit):
    world = anser_world()
    table, baseline = world.references, world.baseline
    dark = replace(world.model, moments=0.0 * world.model.moments)
    nothing = table.select(np.zeros(0, dtype=int))
    for model, references, values, words in (
        (world.model, nothing, baseline[:0], 'no reference sensors'),
        (world.model, table, baseline[:, :3], 'baseline of that shape'),
        (world.model, table.select([0, 0]), baseline[[0, 0]], 'twice in the references'),
        (dark, table, baseline, 'no field'),
    ):
        with pytest.raises(FitError, match=words):
            LiveRefit(model, references, values)
    with pytest.raises(FitError, match='the model has 8 emitters, the fluxes 2'):
        refit.update(1, table.channel, baseline[:, :2])
    with pytest.raises(FitError, match='twice in the frame'):
        refit.update(1, table.channel[[0, 0]], baseline[[0, 0]])
