"""Effects of metal: bodies, their ways, their places, and who lights them."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import world
from effects_scene import candidates, in_force, moving, visiting
from metal_world import induced_moments

from anser_ros.effects.correction import tool_view
from anser_ros.effects.metal_at_rest import REMAINDER, UP_M, Couplings, IlluminationChange
from anser_ros.effects.moving_metal import FreePath, StraightPath, moving_times
from anser_ros.field.model import Dipoles
from anser_ros.metal.body import BODIES, ODD, body_spread, centre_sigma, multipoles, sheet_sources
from anser_ros.physics.constants import MU_0


@pytest.fixture(scope='module')
def problem():
    made = world(frames=60)
    made.track(made.true_track)
    return made.problem()


@pytest.fixture(scope='module')
def found(problem):
    """What is plainly there of each effect, by its name."""
    return {term.effect.name: in_force(term) for term in candidates(problem.apparatus)}


def directions(rng, count):
    axes = rng.normal(size=(count, 3))
    return axes / np.linalg.norm(axes, axis=1)[:, None]


@pytest.mark.long
def test_a_large_perfect_sheet_is_a_mirror():
    source = Dipoles(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.array([[1.0 + 0j]]))
    centre, edges = np.array([0.0, 0.0, -0.1]), np.array([0.9, 0.9])
    sheet = sheet_sources(centre, edges, 1e-9, 36, source, np.array([4e4]))
    image = Dipoles(np.array([[0.0, 0.0, -0.2]]), source.directions, -source.moments)
    points = np.array([[0.0, 0.0, 0.1], [0.05, 0.0, 0.12]])
    np.testing.assert_allclose(sheet.field(points)[:, 2], image.field(points)[:, 2], rtol=0.03)


@pytest.mark.parametrize('made', [moving, visiting])
def test_moving_metal_is_where_it_says(problem, made):
    term = made(problem.apparatus)
    view = tool_view(problem.tools[0], [], problem.fields)
    moved = term.effect.moving_flux(term, view)
    frame = 30
    centre = term.centres(view.time[[frame]])[0]
    fields = problem.fields
    sources = term.shapes.sources(centre, term.couplings, fields.illumination, fields.omega)
    alone = sources.flux(view.centres[frame], view.axes[frame], None)
    scale = np.abs(alone).max()
    np.testing.assert_allclose(moved[frame], alone, rtol=2e-3, atol=1e-3 * scale)


def test_paths_keep_to_their_ends_and_times():
    straight = StraightPath()
    course = np.array([0.0, 0.0, -0.2, 0.1, 0.0, -0.1, 3.0, 7.0, 1.0])
    at = straight.centre(course, np.array([0.0, 3.0, 5.0, 7.0, 9.0]))
    np.testing.assert_allclose(at[[0, 1]], [course[:3]] * 2)
    np.testing.assert_allclose(at[2], (course[:3] + course[3:6]) / 2)
    np.testing.assert_allclose(at[[3, 4]], [course[3:6]] * 2)
    time = np.linspace(0.0, 10.0, 200)
    path, theta = FreePath.through(np.linspace(0, 10, 17), time, straight.centre(course, time))
    apart = path.centre(theta, time) - straight.centre(course, time)
    assert np.abs(apart).max() < 1e-3
    np.testing.assert_allclose(moving_times(path, theta, time), [3.2, 6.8], atol=0.3)


@pytest.mark.parametrize('kind', [*BODIES])
def test_a_body_answers_alike_whoever_asks(kind):
    """Modes, couplings and plain dipoles give one flux; sensor and emitter may change places."""
    shapes = BODIES[kind]()
    rng = np.random.default_rng(5)
    couplings = rng.normal(size=shapes.size) + 1j * rng.normal(size=shapes.size)
    centre, omega = np.array([0.01, 0.02, -0.1]), 2e4 * np.pi * np.array([0.9, 1.0])
    places, axes = rng.uniform(-0.1, 0.1, size=(2, 3)) + [0.0, 0.0, 0.25], directions(rng, 2)
    emitters = Dipoles(places, axes, np.eye(2).astype(complex))
    sources = shapes.sources(centre, couplings, emitters, omega)
    plain = sources.flux(places, axes, None)
    ears = shapes.received(centre, places, axes, np.zeros(2))
    drive = shapes.driven(emitters.field(centre + shapes.offsets))
    np.testing.assert_allclose(shapes.flux(ears, drive, couplings, omega), plain, rtol=1e-9)
    unit = shapes.mode_flux(ears, drive, np.eye(shapes.size), omega)
    np.testing.assert_allclose(unit @ couplings, plain, rtol=1e-9)
    couplings[shapes.first.size :] = 0.0
    there = shapes.sources(centre, couplings, emitters, omega).flux(places, axes, None)
    assert there[0, 1] == pytest.approx(there[1, 0], rel=1e-9)


def test_a_coupled_body_is_a_sum_of_few_multipoles():
    """A hundred coupled balls in a block, seen from the side: less than 3e-3 is left."""
    line = 0.0125 * (np.arange(5) - 2)
    balls = np.array([(1.3 * x, y, 0.7 * z) for x in line for y in line for z in line[1:]])
    centre = np.array([0.0, 0.0, -0.1])
    rng = np.random.default_rng(6)
    below = np.c_[rng.uniform(-0.1, 0.1, size=(6, 2)), np.zeros((6, 1))]
    emitters = Dipoles(below, np.tile([0.0, 0.0, 1.0], (6, 1)), np.eye(6).astype(complex))
    field = emitters.field(centre + balls).transpose(0, 2, 1)
    alpha = np.full(len(balls), -2 * np.pi * 0.0043**3 / MU_0 * (1 + 0.1j))
    moments = induced_moments(centre + balls, alpha, field)
    sources = Dipoles.vectors(centre + balls, moments.transpose(0, 2, 1))
    places = np.c_[rng.uniform(-0.12, 0.12, (150, 2)), rng.uniform(0.1, 0.2, (150, 1))]
    axes = directions(rng, 150)
    wanted = sources.flux(places, axes, None)
    shapes = multipoles()
    ears = shapes.received(centre, places, axes, np.zeros(150))
    drive = shapes.driven(emitters.field(centre + shapes.offsets))
    unit = shapes.mode_flux(ears, drive, np.eye(shapes.size), np.full(6, 4e4))
    unit = (unit * body_spread(0.04, 1.0)).reshape(-1, shapes.size)
    normal = unit.T @ unit
    normal += 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal))
    solution = np.linalg.solve(normal, unit.T @ wanted.ravel())
    left = unit @ solution - wanted.ravel()
    assert np.linalg.norm(left) < 3e-3 * np.linalg.norm(wanted)


def test_the_place_of_metal_is_no_surer_than_its_shape(found):
    """Of a ball's strength, however little the data scatter."""
    radius = 0.04
    ball = -2 * np.pi * radius**3 * np.eye(3).astype(complex)
    assert centre_sigma(ball) == pytest.approx(ODD * radius)
    for name, keys in (('static_metal', ['position_m']), ('moving_metal', ['start_m', 'path'])):
        term = found[name]
        record = term.effect.record(term, np.zeros((term.theta.size, term.theta.size)))
        total = np.array(record.parameters['polarizability']) @ [1.0, 1.0j]
        for key in keys:
            assert np.min(record.uncertainty[key]) >= centre_sigma(total) > 1e-3


@pytest.mark.parametrize('metal', ['static_metal', 'conductive_plate', 'moving_metal'])
def test_a_coil_that_moved_lights_metal_from_where_it_is(problem, found, metal):
    tool, fields = problem.tools[0], problem.fields
    body = found[metal]
    coil = found['coil_moved'].with_theta(np.array([0.004, -0.003, 0.002]))
    alone = tool_view(tool, [body], fields).flux
    both = tool_view(tool, [coil, body], fields).flux

    def there(before: Dipoles) -> Dipoles:
        added = coil.effect.sources(coil, before, before, fields.omega)
        assert added is not None
        return before.joined(added)

    moved = replace(fields, model=there(fields.model), illumination=there(fields.illumination))
    np.testing.assert_allclose(both, tool_view(tool, [body], moved).flux, rtol=1e-9, atol=1e-18)
    k = coil.site['coil']
    lit_anew = both - tool_view(tool, [coil], fields).flux
    lit_before = alone - tool_view(tool, [], fields).flux
    assert np.abs((lit_anew - lit_before)[..., k]).max() > 0.01 * np.abs(lit_before[..., k]).max()


def test_leftovers_are_linear_and_belong_to_their_metal(problem, found):
    parent = found['static_metal']
    shapes = multipoles()
    rng = np.random.default_rng(0)
    modes = 0.1 * rng.normal(size=(shapes.size, 4))
    view = tool_view(problem.tools[0], [], problem.fields)
    for leftover in (
        Couplings(shapes, parent.theta[:3], modes),
        IlluminationChange([parent], problem.apparatus.emitters),
    ):
        term = REMAINDER.of(parent, leftover)
        assert term.belongs_to(parent.hold())
        assert not term.belongs_to(replace(parent, site={'place': (9.0, 9.0, 9.0)}))
        assert not parent.belongs_to(term)
        term = term.with_theta(rng.normal(size=leftover.count))
        more = tool_view(problem.tools[0], [term], problem.fields).flux - view.flux
        columns = REMAINDER.columns(term, view)
        scale = np.abs(more).max()
        np.testing.assert_allclose(columns @ term.theta, more, rtol=1e-6, atol=1e-6 * scale)


def test_lighting_is_an_emitter_that_sits_higher(problem, found):
    """A metal that sees one emitter 0.4 mm higher, told by another illumination."""
    parent = found['static_metal']
    view = tool_view(problem.tools[0], [], problem.fields)
    light = view.illumination
    lighting = IlluminationChange([parent], problem.apparatus.emitters)
    column = lighting.columns(view)[..., 3 * problem.apparatus.emitters + 1]
    higher = replace(light, positions=light.positions + [0.0, 0.0, UP_M])
    there, here = (parent.effect.sources(parent, i, i, view.omega) for i in (higher, light))
    wanted = view.along(there.flux(*view.flat) - here.flux(*view.flat))[..., 1]
    np.testing.assert_allclose(column[..., 1], wanted, atol=0.01 * np.abs(wanted).max())
    assert not np.any(column[..., [0, 2]])
