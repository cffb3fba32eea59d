"""Metal: spheres, bodies, their ways and places, who lights them, and what has departed."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import board, world
from effects_scene import candidates, in_force, moving, visiting
from metal_world import induced_moments

from anser_ros.diagnosis import departure as departing
from anser_ros.diagnosis.departure import departure
from anser_ros.diagnosis.problem import evaluate, train_blocks
from anser_ros.effects.correction import tool_view
from anser_ros.effects.metal_at_rest import REMAINDER, UP_M, Couplings, IlluminationChange
from anser_ros.effects.moving_metal import DepartedMetal, FreePath, StraightPath, moving_times
from anser_ros.field.model import Dipoles
from anser_ros.metal import body as bodies
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
    sheet = bodies.sheet_sources(centre, edges, 1e-9, 36, source, np.array([4e4]))
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


@pytest.mark.parametrize('kind', [*bodies.BODIES])
def test_a_body_answers_alike_whoever_asks(kind):
    """Modes, couplings and plain dipoles give one flux; sensor and emitter may change places."""
    shapes = bodies.BODIES[kind]()
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
    shapes = bodies.multipoles()
    ears = shapes.received(centre, places, axes, np.zeros(150))
    drive = shapes.driven(emitters.field(centre + shapes.offsets))
    unit = shapes.mode_flux(ears, drive, np.eye(shapes.size), np.full(6, 4e4))
    unit = (unit * bodies.body_spread(0.04, 1.0)).reshape(-1, shapes.size)
    normal = unit.T @ unit
    normal += 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal))
    solution = np.linalg.solve(normal, unit.T @ wanted.ravel())
    left = unit @ solution - wanted.ravel()
    assert np.linalg.norm(left) < 3e-3 * np.linalg.norm(wanted)


def test_the_place_of_metal_is_no_surer_than_its_shape(found):
    """Of a ball's strength, however little the data scatter."""
    radius = 0.04
    ball = -2 * np.pi * radius**3 * np.eye(3).astype(complex)
    assert bodies.centre_sigma(ball) == pytest.approx(bodies.ODD * radius)
    for name, keys in (('static_metal', ['position_m']), ('moving_metal', ['start_m', 'path'])):
        term = found[name]
        record = term.effect.record(term, np.zeros((term.theta.size, term.theta.size)))
        total = np.array(record.parameters['polarizability']) @ [1.0, 1.0j]
        for key in keys:
            assert np.min(record.uncertainty[key]) >= bodies.centre_sigma(total) > 1e-3


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
    shapes = bodies.multipoles()
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


REST, NEAREST = np.array([0.12, -0.1, -0.16]), np.array([0.03, -0.02, -0.08])
BALLS = np.array([[0.0, 0.0, 0.0], [0.04, 0.01, 0.0], [-0.01, 0.035, 0.01]])
"""Places of the balls of a piece of metal, m."""


def metal_at(centre, light, omega):
    """Dipoles of three conducting balls that do not see each other."""
    points = centre + BALLS
    strength = bodies.sphere_polarisability(0.016, 3.5e7, 1.0, omega)
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


RADIUS = 0.02


def polarisability(radius, conductivity, permeability, frequency):
    """Return the sphere's polarisability at one frequency, m^3."""
    omega = np.array([2 * math.pi * frequency])
    return MU_0 * bodies.sphere_polarisability(radius, conductivity, permeability, omega)[0]


def test_static_permeable_sphere():
    """4 pi a^3 (mu_r - 1)/(mu_r + 2), Jackson section 5.11."""
    for permeability in (1.0, 2.0, 1000.0):
        alpha = polarisability(RADIUS, 0.0, permeability, 0.0)
        expected = 4 * math.pi * RADIUS**3 * (permeability - 1) / (permeability + 2)
        assert alpha == pytest.approx(expected, abs=1e-18)


@pytest.mark.parametrize('frequency', [1.0, 1e2, 1e3, 1e4, 1e6])
def test_conductor_against_the_bessel_series(frequency):
    """alpha = -2 pi a^3 (1 + 3/x^2 - 3 coth(x)/x) for mu_r = 1 (Landau and Lifshitz, 59.4)."""
    x = RADIUS * cmath.sqrt(2j * math.pi * frequency * MU_0 * 3.5e7)
    coth = cmath.cosh(x) / cmath.sinh(x) if x.real < 300 else 1.0
    expected = -2 * math.pi * RADIUS**3 * (1 + 3 / x**2 - 3 * coth / x)
    alpha = polarisability(RADIUS, 3.5e7, 1.0, frequency)
    assert alpha == pytest.approx(expected, rel=1e-6)
    assert alpha.real < 0
    assert alpha.imag < 0, 'an induced moment lags'


def test_the_series_and_the_closed_form_meet():
    edge = (bodies.SMALL / RADIUS) ** 2 / MU_0
    below, above = bodies.sphere_polarisability(
        RADIUS, 1.0, 1.0, edge * np.array([0.99999, 1.00001])
    )
    assert above == pytest.approx(below, rel=5e-5)


@pytest.mark.parametrize('arguments', [(0.0, 1.0, 1.0, 1.0), (1.0, 1.0, 0.0, 1.0),
                                       (1.0, -1.0, 1.0, 1.0), (1.0, 1.0, 1.0, -1.0)])  # fmt: skip
def test_impossible_spheres_are_refused(arguments):
    with pytest.raises(ValueError, match='must'):
        polarisability(*arguments)


def test_coupled_pair_along_the_line_that_joins_them():
    """Two spheres in an axial field: alpha_eff = alpha / (1 - alpha / (2 pi d^3))."""
    distance = 0.05
    positions = np.array([[0, 0, 0], [0, 0, distance]])
    alpha = 4 * math.pi * RADIUS**3
    field = np.tile([0.0, 0.0, 1e-6], (2, 1, 1))
    moments = induced_moments(positions, np.full(2, alpha / MU_0), field)
    expected = alpha / (1 - alpha / (2 * math.pi * distance**3)) * 1e-6 / MU_0
    np.testing.assert_allclose(moments[:, 0, 2], expected, rtol=1e-12)
