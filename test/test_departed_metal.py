"""Metal that rested near a scan and moved during it: what it did at rest is told by its moving."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import board, world

from anser_ros.diagnosis import departure as departing
from anser_ros.diagnosis.departure import departure
from anser_ros.diagnosis.problem import evaluate, train_blocks
from anser_ros.effects.moving_metal import DepartedMetal, FreePath
from anser_ros.field.model import Dipoles
from anser_ros.metal.body import sphere_polarisability

REST, NEAREST = np.array([0.12, -0.1, -0.16]), np.array([0.03, -0.02, -0.08])
BALLS = np.array([[0.0, 0.0, 0.0], [0.04, 0.01, 0.0], [-0.01, 0.035, 0.01]])
"""Places of the balls of a piece of metal, m."""


def metal_at(centre, light, omega):
    """Dipoles of three conducting balls that do not see each other."""
    points = centre + BALLS
    strength = sphere_polarisability(0.016, 3.5e7, 1.0, omega)
    return Dipoles.vectors(points, light.field(points) * strength)


@pytest.fixture(scope='module')
def scanned():
    """A problem whose model and baseline have the metal at rest, and the metal's field there."""
    made = world(seed=3, frames=500)
    light = made.field
    omega = 2 * np.pi * np.asarray(made.model.frequencies_hz)
    duration = float(made.tool.time[-1])

    def place(time):
        share = np.sin(np.pi * time / duration) ** 2
        return REST + share * (NEAREST - REST)

    position, rotation = made.true_pose()
    centres, axes = made.tool.sensors.placed(position, rotation)
    fixed = made.reference.sensors
    flux, reference = made.tool.flux.copy(), made.reference.flux.copy()
    for i, time in enumerate(made.tool.time.tolist()):
        sources = metal_at(place(time), light, omega)
        flux[i] += sources.flux(centres[i], axes[i], made.tool.sensors.length)
        reference[i] += sources.flux(fixed.position, fixed.axis, fixed.length)
    resting = metal_at(REST, light, omega)
    learnt = light.joined(resting)
    made.model = replace(made.model, **vars(learnt))
    made.drawn = board()
    made.baseline = made.baseline + resting.flux(fixed.position, fixed.axis, fixed.length)
    made.flux(flux)
    made.references(reference)
    return made.problem(), resting


def test_metal_at_rest_changes_nothing_and_its_derivatives_are_right(scanned):
    problem, _ = scanned
    rows = np.arange(0, 500, 125)
    part = problem.in_blocks(train_blocks()).frames([rows[:3]], rows[:1])
    view = evaluate(part, ()).parts[0].view
    path = FreePath((0.0, 7.0, 14.0, 20.0))
    course = np.array([REST, NEAREST, (REST + NEAREST) / 2, REST]).ravel()
    effect = DepartedMetal(rest_s=7.0)
    term = effect.starting(path, course, 20.0, np.array([-0.5, 0.1]))
    assert not effect.moving_flux(term, term.resting(view)).any()
    columns = effect.columns(term, view)
    for index in (0, 4, 11, path.count, term.theta.size - 1):
        step = 1e-5 * np.eye(term.theta.size)[index]
        more, less = (
            effect.moving_flux(term.with_theta(term.theta + s), view) for s in (step, -step)
        )
        slope = (more - less) / 2e-5
        assert np.abs(columns[..., index] - slope).max() < 2e-2 * np.abs(slope).max() + 1e-16


@pytest.mark.long
def test_what_metal_does_at_rest_is_found_from_how_it_moves(scanned, monkeypatch):
    problem, resting = scanned
    monkeypatch.setattr(departing, '_ways', lambda: [np.array([0.1, -0.06, -0.06])])
    monkeypatch.setattr(departing, 'MANY_FRAMES', 100)
    monkeypatch.setattr(departing, 'SPACINGS', {})
    found = departure(problem, 0.0)
    assert found is not None and found.is_predictive and found.before > 5.0 * found.after
    view = evaluate(problem.in_blocks(np.array([3, 12])), ()).parts[0].view
    flux, sigma = found.rest_flux(view)
    truth = view.along(resting.flux(*view.flat))
    size = np.sqrt(np.mean(np.abs(truth) ** 2))
    assert np.sqrt(np.mean(np.abs(flux - truth) ** 2)) < 0.2 * size
    assert 0.0 < sigma.mean() < 0.3 * size
    assert departure(replace(problem, references=None), 0.0) is None
