"""Terms of every effect for tests: candidates, metal on its way, and what is plainly there."""

from dataclasses import replace

import numpy as np

from anser_ros.effects.effect import Term, all_effects
from anser_ros.effects.moving_metal import FreePath, StraightPath
from anser_ros.field.model import Dipoles
from anser_ros.metal.body import lattice


def moving(scene) -> Term:
    effect = all_effects()['moving_metal']
    place = np.array([0.02, 0.0, -0.12])
    course = np.concatenate([place, place + [0.05, 0.02, 0.03], [0.5, 1.9, 0.5]])
    return effect.starting(StraightPath(), course, 2.4, np.array([-2.0, -0.3]))


def visiting(scene) -> Term:
    """Metal that comes and leaves again, of an extended body."""
    effect = all_effects()['moving_metal']
    knots = np.linspace(0.0, 2.4, 5)
    course = np.array([0.02, 0.01, -0.2]) + np.outer([0.0, 1.0, 2.0, 1.0, 0.0], [0.03, 0.0, 0.02])
    path, theta = FreePath.through(knots, knots, course)
    term = effect.starting(path, theta, 2.4, np.array([-2.0, -0.3]))
    rng = np.random.default_rng(4)
    modes = 0.02 * rng.normal(size=(lattice(0.035).size, 3))
    rich = term.with_body('extended 35 mm', modes, np.ones(3))
    return rich.with_theta(np.concatenate([theta, rng.normal(size=6)]))


def undrawn(scene):
    """The same apparatus with one dipole for each emitter, as no drawing has it."""
    light, moments = scene.illumination, np.eye(scene.emitters, dtype=complex)
    places, axes = light.positions[: scene.emitters], np.tile([0.6, 0.0, 0.8], (scene.emitters, 1))
    return replace(scene, illumination=Dipoles(places, axes, moments))


def candidates(scene) -> list[Term]:
    """The first candidate of every kind of site of every effect."""
    terms, seen = [], set()
    for effect in all_effects().values():
        for term in [*effect.candidates(scene), *effect.candidates(undrawn(scene))]:
            kind = (effect.name, tuple(sorted(term.site)))
            if term.theta.size and kind not in seen:
                seen.add(kind)
                terms.append(term)
    return [*terms, moving(scene), visiting(scene)]


def in_force(term: Term) -> Term:
    """The term with parameters that are plainly there."""
    rng = np.random.default_rng(3)
    small = {
        'lever_arm': 1e-3, 'sensor_position': 1e-3, 'coil_moved': 1e-3, 'registration': 1e-3,
        'time_offset': 0.01, 'clock_rate': 1e-3, 'pickup': 2.0, 'phase_delay': 1.0,
        'registration_drift': 1e-3, 'optical_scale': 1e-3, 'reference_changed': 2.0,
        'sensor_size': 2.0, 'saturation': 0.01,
    }  # fmt: skip
    if term.effect.name == 'coil_drift':
        return term.with_theta(np.array([0.03, np.log(0.8)]))
    if term.effect.name == 'static_metal':
        theta = rng.normal(size=term.theta.size)
        return term.with_theta(np.concatenate([[0.05, 0.02, -0.1], theta[3:]]))
    if term.effect.name in ('conductive_plate', 'moving_metal'):
        return term
    scale = small.get(term.effect.name, 0.02)
    return term.with_theta(scale * (0.5 + np.abs(rng.normal(size=term.theta.size))))
