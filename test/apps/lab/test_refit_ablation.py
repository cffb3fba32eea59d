"""The refit's ablation: references spread out, the rival without shared polarisability, a plot."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO
from refit_world import NOISE_T, anser_world, metal_block, volume_points

sys.path.append(str(REPO / 'test' / 'bench'))

from ablation import FREE, FROZEN, SHARED, FreeDipoles, ablate, plot, spread_out

from anser_ros.field.nominal import nominal_model
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import board_of

pytestmark = pytest.mark.usefixtures('shared_tables')

BAGS = REPO / 'bags'


def test_references_are_spread_out():
    table = anser_world(32).references
    rows = spread_out(table, 4)
    assert len(set(rows.tolist())) == 4
    gaps = np.linalg.norm(table.position[rows][:, None] - table.position[rows], axis=2)
    assert gaps[np.triu_indices(4, 1)].min() > 0.15
    np.testing.assert_array_equal(spread_out(table, 99), np.arange(32))


@pytest.mark.long
def test_free_dipoles_correct_but_less_than_the_shared_polarisability():
    world = anser_world()
    points = metal_block([0.03, -0.02, -0.11], [0.1, 0.12, 0.06])
    flux = world.baseline + world.metal(points) + world.noise(np.random.default_rng(1))
    free = FreeDipoles(world.model, world.references, world.baseline, world.board.field)
    model = free.update(flux)
    places, axes = volume_points()
    table = world.references.select(np.arange(len(places)) % 16)
    truth = world.metal(
        points, replace(table, position=places, axis=axes, length=np.zeros(len(places)))
    )
    left = truth - (model.flux(places, axes) - world.model.flux(places, axes))
    share = np.linalg.norm(left) / np.linalg.norm(truth)
    shared = world.refit().update(1, world.references.channel, flux).model
    left = truth - (shared.flux(places, axes) - world.model.flux(places, axes))
    assert np.linalg.norm(left) / np.linalg.norm(truth) < 0.3 * share < 0.3
    still = free.update(world.baseline + world.noise(np.random.default_rng(2)))
    assert np.abs(still.flux(places, axes) - world.model.flux(places, axes)).max() < 5 * NOISE_T


@pytest.mark.long
def test_the_ablation_runs_on_a_recording(tmp_path):
    session, baseline = load_session(BAGS / 'metal.mcap'), load_session(BAGS / 'factory.mcap')
    model = nominal_model(board_of(session.setup))
    rows = ablate(session, 'metal', model, baseline, counts=(8, 99), every=40)
    assert [(r.method, r.references) for r in rows] == [(FROZEN, 0), (FREE, 8), (SHARED, 8)]
    frozen, free, shared = (row.rmse_m for row in rows)
    assert shared < free < frozen
    plot(rows, tmp_path / 'plot.png', {'metal': 'metal'})
    assert (tmp_path / 'plot.png').stat().st_size > 5000
