"""The refit's algebra against its plain definition: dense normal distributions and brute force."""

import numpy as np
import pytest
from refit_world import anser_world, metal_block, metal_flux, volume_points
from scipy.stats import multivariate_normal

from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import along_each_axis
from anser_ros.refit import health
from anser_ros.refit.clouds import (
    Region,
    below,
    bodies,
    default_clouds,
    excitation_for,
    overhead,
    region_of,
)
from anser_ros.refit.frame import Average, NoiseLevel, Pace
from anser_ros.refit.health import distance_of, evidence_without, left_out
from anser_ros.refit.layer import bottom_layer, box_layer, component_rows
from anser_ros.refit.posterior import STRENGTHS, Bank, error_level, error_modes
from anser_ros.refit.prior import (
    ORIENTED,
    UPRIGHT,
    Response,
    build_prior,
    survey_variants,
    vector_basis,
)
from anser_ros.refit.tables import REMAINDER, BodySearch, body_factor
from anser_ros.settings import Accuracy

pytestmark = pytest.mark.usefixtures('shared_tables')
K = 8
NOISE = 1.3


@pytest.fixture(scope='module')
def world():
    return anser_world()


@pytest.fixture(scope='module')
def parts(world):
    """Excitation, region, layer and two priors of six references."""
    excitation, region = excitation_for(world.model, world.board.field)
    clouds = [below(region, 0.06), below(region, 0.12)]
    layer = bottom_layer(region, excitation)
    references = world.references.select(range(6))
    rng = np.random.default_rng(1)
    priors = [
        build_prior(
            cloud, response, layer, references, excitation.field(cloud.positions),
            np.array(world.model.frequencies_hz), Accuracy(), rng,
        )
        for cloud, response in zip(clouds, (UPRIGHT, ORIENTED), strict=True)
    ]  # fmt: skip
    return excitation, region, layer, references, priors


@pytest.fixture(scope='module')
def drift(world):
    out = np.zeros((6 * K, K))
    for k in range(K):
        out[k::K, k] = 2.0 * world.baseline[:6, k].real / np.abs(world.baseline[:6]).max()
    return out


@pytest.fixture(scope='module')
def bank(parts, drift):
    return Bank(parts[4], np.arange(6 * K), drift)


@pytest.fixture(scope='module')
def readings(parts):
    rng = np.random.default_rng(3)
    prior = parts[4][0]
    metal = np.sqrt(1e4) * np.linalg.cholesky(prior.covariance + 1e-9 * np.eye(6 * K))
    return metal @ rng.normal(size=(6 * K, 2)) * [1.0, 0.2] + NOISE * rng.normal(size=(6 * K, 2))


def dense(parts, drift, hypothesis, strength):
    """Covariance of the readings as it is defined."""
    noise = NOISE**2 * (np.eye(len(drift)) + drift @ drift.T)
    if hypothesis == 0:
        return noise
    return strength * parts[4][hypothesis - 1].covariance + noise


def test_evidence_is_that_of_the_dense_normal_distribution(bank, parts, drift, readings):
    seen = bank.evaluate(readings, NOISE)
    constant = 0.5 * 6 * K * np.log(2 * np.pi)
    half = 0.5 * np.linalg.slogdet(np.eye(6 * K) + drift @ drift.T)[1]
    for hypothesis in range(3):
        for a in (0, 7, 12):
            covariance = dense(parts, drift, hypothesis, STRENGTHS[a])
            for part in range(2):
                expected = multivariate_normal.logpdf(readings[:, part], cov=covariance)
                got = seen.curve[hypothesis, part, a] - constant - half
                assert got == pytest.approx(expected, rel=1e-4)
    assert int(seen.log_evidence.argmax()) == 1
    np.testing.assert_allclose(seen.strength.sum(axis=2), 1.0)


def test_posterior_mean_is_the_dense_one(bank, parts, drift, readings):
    seen = bank.evaluate(readings, NOISE)
    prior = parts[4][0]
    expected = np.zeros((len(prior.transfer), 2))
    innovation = np.zeros_like(readings)
    for part in range(2):
        for a, probability in enumerate(seen.strength[1, part]):
            if probability < 1e-9:
                continue
            inverse = np.linalg.inv(dense(parts, drift, 1, STRENGTHS[a]))
            q = probability * (inverse @ readings[:, part])
            innovation[:, part] += q
            expected[:, part] += STRENGTHS[a] * (prior.transfer @ q)
    got = bank.moments(seen, 1).view(float).reshape(-1, 2)
    assert np.abs(got - expected).max() < 1e-4 * np.abs(expected).max()
    mean, variance = bank.drifts(seen, 1)
    np.testing.assert_allclose(mean, NOISE**2 * drift.T @ innovation, atol=1e-3 * NOISE)
    assert ((variance > 0) & (variance <= NOISE**2 * (1 + 1e-9))).all()


def test_leaving_out_needs_no_new_decomposition(bank, parts, drift, readings):
    seen = bank.evaluate(readings, NOISE)
    for coils in ([2], [0, 4]):
        rest = np.setdiff1d(np.arange(6), coils)
        rows = (rest[:, None] * K + np.arange(K)).ravel()
        other = Bank(parts[4], rows, drift)
        direct = other.evaluate(readings[rows], NOISE)
        evidences, residuals = evidence_without(bank, seen, np.array(coils))
        evidence, residual = evidences[-1], residuals[-1].reshape(len(coils), K, 2)
        shift = evidence - direct.log_evidence
        np.testing.assert_allclose(shift, shift[0], atol=2e-3 * np.abs(evidence).max())
        gone = (np.array(coils)[:, None] * K + np.arange(K)).ravel()
        assert residual.shape == (len(coils), K, 2)
        if len(coils) == 1:
            chi2 = distance_of(other, direct, gone, readings[gone], NOISE)
            here, _ = left_out(bank, seen)
            assert seen.best == direct.best
            assert here[coils[0]] == pytest.approx(chi2, rel=0.02)


def test_a_healthy_coil_is_not_at_fault_and_a_wild_one_is(bank, readings):
    seen = bank.evaluate(readings, NOISE)
    assert all(health.fault_odds(bank, seen, np.array([c]))[0] < 5.0 for c in range(6))
    wild = readings.copy()
    wild[3 * K : 4 * K] += 3000.0
    seen = bank.evaluate(wild, NOISE)
    odds = [health.fault_odds(bank, seen, np.array([c]))[0] for c in range(6)]
    assert int(np.argmax(odds)) == 3
    together = health.fault_odds(bank, seen, np.array([3, 1, 5]))
    assert together[0] == pytest.approx(odds[3])
    assert together[2] == pytest.approx(health.fault_odds(bank, seen, np.array([5, 1, 3]))[2])


def test_error_modes_have_the_posterior_s_power(bank, parts, drift, readings):
    seen = bank.evaluate(readings, NOISE)
    level = error_level(seen, 1)
    assert level.noise >= NOISE
    modes = error_modes(bank, bank.posterior(1), level, 90)
    prior = parts[4][0]
    strength = STRENGTHS[level.strengths[0]]
    covariance = strength * prior.covariance
    covariance += level.noise**2 * (np.eye(len(drift)) + drift @ drift.T)
    # The prior's own share from many draws, the data's share exactly.
    draws = np.sqrt(strength) * prior.draw_moments
    gain = strength * prior.transfer
    before = (draws**2).mean(axis=1).sum()
    after = before - np.trace(gain @ np.linalg.solve(covariance, gain.T))
    real = (modes.moments.real**2).sum()
    assert real == pytest.approx(after, rel=0.5)
    assert modes.rest >= 0.0
    few = error_modes(bank, bank.posterior(1), level, 4)
    assert len(few.moments) == 4
    assert few.rest > modes.rest


@pytest.mark.long
def test_layers_stand_for_their_clouds_also_between_their_samples(world, parts):
    excitation, region, layer, _, _ = parts
    rng, half = np.random.default_rng(1), region.half
    across = rng.uniform(-half, half, (100, 2)) + region.centre
    points = np.column_stack(
        [across, rng.uniform(region.volume.low[2], 0.83 * region.volume.ceiling, 100)]
    )
    for cloud in default_clouds(region):
        stand_in = box_layer(region, excitation) if cloud.overhead else layer
        limit = 0.25 if cloud.overhead else 0.04 if cloud.standoff_m < 0.2 * half else 0.01
        wanted = component_rows(points, *along_each_axis(cloud.positions))
        made = component_rows(points, stand_in.positions, stand_in.directions)
        off = made @ stand_in.project(cloud.positions) - wanted
        assert np.linalg.norm(off) < limit * np.linalg.norm(wanted), cloud.name
        assert len(stand_in.positions) <= 200


def test_clouds_stay_out_of_the_volume_and_weigh_their_volume():
    region = Region(np.array([0.01, -0.02]), 0.15)
    for cloud in default_clouds(region):
        assert (cloud.volumes > 0).all()
        p = cloud.positions - [*region.centre, 0.0]
        inside = (np.abs(p[:, 0]) < region.half) & (np.abs(p[:, 1]) < region.half)
        assert not (inside & (p[:, 2] > 0) & (p[:, 2] < region.volume.ceiling)).any()
        if not cloud.overhead:
            assert p[:, 2].max() == pytest.approx(-cloud.standoff_m)
    near, far = overhead(region, 0.04), overhead(region, 0.1)
    assert len(near.positions) > len(far.positions)


def test_region_is_where_the_board_is(world):
    region = region_of(world.board.field)
    np.testing.assert_allclose(region.centre, 0.0, atol=2e-3)
    assert 0.12 < region.half < 0.17

    def elsewhere(points):
        return world.board.field(points - [0.1, -0.2, 0.0])

    np.testing.assert_allclose(region_of(elsewhere).centre, [0.1, -0.2], atol=3e-3)


def test_survey_variants_are_the_first_order_of_a_wrong_survey(world):
    table = world.references.select([1])
    source = np.array([[0.02, 0.03, -0.08]])
    survey = Accuracy(reference_position_m=1e-5, reference_axis_rad=1e-4, reference_gain=0.01)
    plain = vector_basis(table.position, table.axis, table.length, source)
    gain, turn, _, x, _, _ = survey_variants(table, source, survey)
    np.testing.assert_allclose(gain, 0.01 * plain)
    moved = vector_basis(table.position + [1e-5, 0, 0], table.axis, table.length, source)
    np.testing.assert_allclose(x, moved - plain, atol=2e-3 * np.abs(moved - plain).max())
    assert np.abs(turn).max() < 1e-3 * np.abs(plain).max()


def test_the_pace_is_kept_by_the_stamps_alone():
    pace, second = Pace(50.0), 10**9
    due = [pace.is_due(second + i * second // 100) for i in range(400)]
    assert 195 <= sum(due) <= 210
    assert all(due[:5]), 'a few frames may follow each other at once'
    assert pace.is_due(second // 2), 'time that jumps back starts anew'
    slow = Pace(50.0)
    assert all(slow.is_due(second + i * second // 40) for i in range(100))


def test_noise_is_measured_whatever_moves_smoothly():
    rng, level = np.random.default_rng(1), NoiseLevel(60e-12)
    for frame in range(300):
        moving = 1e-9 * frame * np.ones((16, 8))
        noise = rng.normal(size=(16, 8)) + 1j * rng.normal(size=(16, 8))
        flux = moving + 180e-12 * noise
        flux[3] = np.nan
        flux[5] += rng.normal() * 1e-6  # one that is broken says nothing of the others
        ratio = level.update(flux)
    assert ratio == pytest.approx(3.0, rel=0.12)
    level.forget()
    assert level.update(flux) == ratio


def test_readings_are_averaged_until_they_change():
    rng, average = np.random.default_rng(1), Average(5)

    def frame(value):
        return value + 1e-10 * (rng.normal(size=(16, 8)) + 1j * rng.normal(size=(16, 8)))

    for _ in range(12):
        mean, count = average.update(frame(1e-6), 1e-10)
    assert count == 5
    assert np.abs(mean - 1e-6).std() < 0.08e-9
    mean, count = average.update(frame(1e-6 + 4e-10), 1e-10)
    assert count == 1
    gone = frame(1e-6)
    gone[2] = np.nan
    assert average.update(gone, 1e-10)[1] == 1
    average.forget()
    assert average.update(frame(2e-6), 1e-10)[1] == 1


@pytest.mark.parametrize('response', [Response(), UPRIGHT, ORIENTED, Response('all', 2.0, 0.6)])
def test_priors_are_the_covariance_of_their_own_draws(world, parts, response):
    excitation, region, layer, references, _ = parts
    cloud = below(region, 0.16)
    tones = np.array(world.model.frequencies_hz)
    arguments = (cloud, response, layer, references, excitation.field(cloud.positions), tones)
    seeds = range(30)
    priors = [build_prior(*arguments, Accuracy(), np.random.default_rng(seed)) for seed in seeds]
    draws = np.concatenate([prior.draw_readings for prior in priors], axis=1)
    moments = np.concatenate([prior.draw_moments for prior in priors], axis=1)
    count = draws.shape[1]
    sampled = draws @ draws.T / count
    exact = priors[0].covariance
    assert np.abs(sampled - exact).max() < 6.0 * np.diag(exact).max() / np.sqrt(count)
    assert np.trace(exact) == pytest.approx(len(exact))
    across = moments @ draws.T / count
    scale = np.sqrt((moments**2).mean(axis=1)[:, None] * np.diag(exact)[None, :])
    assert np.abs((across - priors[0].transfer) / scale).max() < 6.0 / np.sqrt(count)
    np.testing.assert_allclose(exact, exact.T, atol=1e-12)
    assert np.linalg.eigvalsh(exact).min() > -1e-10


BESIDE = metal_block([0.24, 0.03, 0.12], [0.06, 0.06, 0.06])
STRONG = -6000.0 + 800.0j


@pytest.fixture(scope='module')
def refit():
    return anser_world().refit()


def follow(refit, points, frames=6, seed=1):
    world, rng = anser_world(), np.random.default_rng(seed)
    change = metal_flux(
        world.board, points, world.references.position, world.references.axis, STRONG
    )
    refit.reset()
    for frame in range(frames):
        flux = world.baseline + change + world.noise(rng)
        result = refit.update(10**9 + frame * 40_000_000, world.references.channel, flux)
    return result


def test_approximate_evidence_is_that_of_its_own_normal_distribution():
    world, rng = anser_world(), np.random.default_rng(2)
    region = Region(np.zeros(2), 0.13)
    cloud = bodies(region)[40]
    table = world.references.select(range(5))
    factor = body_factor(cloud, table, world.board.field(cloud.positions[:7]))
    strengths = np.array([1.0, 1e3, 1e6])
    count = len(factor)
    search = BodySearch((factor,), np.arange(count), np.eye(count), strengths)
    readings = 20.0 * rng.normal(size=(count, 2))
    u, s, _ = np.linalg.svd(factor.astype(float), full_matrices=False)
    kept = (u[:, :16] * s[:16] ** 2) @ u[:, :16].T
    expected = 0.0
    for part in range(2):
        each = [
            multivariate_normal(
                None, a * (kept + REMAINDER * np.eye(count)) + 1.5**2 * np.eye(count)
            ).logpdf(readings[:, part])
            for a in strengths
        ]
        expected += np.log(np.mean(np.exp(np.array(each) - max(each)))) + max(each)
    got = search.scores(readings, 1.5)[0] - count * np.log(2.0 * np.pi)
    assert got == pytest.approx(expected, rel=1e-4)


@pytest.mark.long
def test_metal_beside_the_volume_is_found_corrected_and_honest(refit):
    world, result = anser_world(), follow(refit, BESIDE)
    best = max(result.weights, key=result.weights.get)
    assert best.startswith('body')
    assert np.linalg.norm(result.metal.centroid - BESIDE.mean(axis=0)) < 0.04
    points, axes = volume_points()
    truth = metal_flux(world.board, BESIDE, points, axes, STRONG)
    found = result.model.flux(points, axes) - world.model.flux(points, axes)
    assert np.linalg.norm(found - truth) < 0.1 * np.linalg.norm(truth)
    model = result.model
    basis = flux_basis(points, axes, None, model.positions, model.directions)
    modes = np.einsum('pn,rnk->rpk', basis, model.modes, optimize=True)
    sigma = np.sqrt((np.abs(modes) ** 2).sum(axis=0) + 2.0 * model.flux_error_t**2)
    assert np.sqrt(np.mean((np.abs(found - truth) / sigma) ** 2)) < 2.0


@pytest.mark.long
def test_slots_follow_metal_that_moves_and_are_emptied_by_a_reset(refit):
    before, after = (
        {name for name in follow(refit, BESIDE + [0.0, y, 0.0], 16).weights if 'body' in name}
        for y in (-0.12, 0.12)
    )
    assert len(before) == len(after) == 3 and not before & after
    refit.reset()
    flux = anser_world().baseline
    result = refit.update(1, anser_world().references.channel, flux)
    assert result.model is anser_world().model
    assert not any('body' in name for name in result.weights)
    # The same readings give the same model again, whatever was seen before.
    once, again = follow(refit, BESIDE), follow(refit, BESIDE)
    np.testing.assert_array_equal(once.model.moments, again.model.moments)
