"""Compact bodies as hypotheses: found where they are, by an evidence that is the dense one."""

import numpy as np
import pytest
from refit_world import anser_world, metal_block, metal_flux, volume_points
from scipy.stats import multivariate_normal

from anser_ros.physics.dipole import flux_basis
from anser_ros.refit.clouds import Region, bodies
from anser_ros.refit.tables import REMAINDER, BodySearch, body_factor

pytestmark = pytest.mark.usefixtures('shared_tables')

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
