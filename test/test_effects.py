"""Effects: every derivative against differences, every correction against its forward model."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import world
from metal_world import induced_moments

from anser_ros.effects.correction import Correction
from anser_ros.effects.effect import Effect, Family, Remedy
from anser_ros.effects.metal_path import FreePath, StraightPath, moving_times
from anser_ros.effects.metal_remainder import REMAINDER, UP_M, Couplings, Lighting
from anser_ros.effects.prediction import reference_view, tool_view
from anser_ros.effects.registry import all_effects, effect_named
from anser_ros.effects.saturation import compressed
from anser_ros.effects.term import Term
from anser_ros.errors import ModelFileError
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord
from anser_ros.metal.body import (
    BODIES,
    ODD,
    body_spread,
    centre_sigma,
    lattice,
    multipoles,
)
from anser_ros.metal.sheet import sheet_sources
from anser_ros.physics.constants import MU_0

CONTRACT = {
    'sensor_gain', 'sensor_axis', 'sensor_polarity', 'sensor_size', 'lever_arm', 'registration',
    'time_offset', 'channel_crosstalk', 'coil_crosstalk', 'coil_drift', 'coil_moved', 'pickup',
    'saturation', 'phase_delay', 'static_metal', 'conductive_plate', 'moving_metal',
    'excess_noise', 'outliers',
}  # fmt: skip


@pytest.fixture(scope='module')
def scenery():
    made = world(frames=60)
    made.move_track(made.true_track)
    return made, made.problem()


def _moving(scene) -> Term:
    effect = all_effects()['moving_metal']
    place = np.array([0.02, 0.0, -0.12])
    course = np.concatenate([place, place + [0.05, 0.02, 0.03], [0.5, 1.9, 0.5]])
    return effect.starting(StraightPath(), course, 2.4, np.array([-2.0, -0.3]))


def _visiting(scene) -> Term:
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


def _candidates(scene) -> list[Term]:
    """The first candidate of every kind of site of every effect."""
    terms, seen = [], set()
    for effect in all_effects().values():
        for term in effect.candidates(scene):
            kind = (effect.name, tuple(sorted(term.site)))
            if term.theta.size and kind not in seen:
                seen.add(kind)
                terms.append(term)
    return [*terms, _moving(scene), _visiting(scene)]


def _in_force(term: Term) -> Term:
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


def test_every_name_of_the_contract_is_found():
    effects = all_effects()
    assert set(effects) >= CONTRACT
    for name, effect in effects.items():
        assert effect.name == name
        assert effect.summary
        assert effect.units
        assert isinstance(effect.remedy, Remedy)


def test_effects_declare_what_the_search_needs(scenery):
    """Whoever adds an effect of a family must give what that family is refined with."""
    apparatus = scenery[1].apparatus
    for name, effect in all_effects().items():
        terms = [*effect.candidates(apparatus)]
        if effect.still is not None:
            assert effect.still in all_effects().values(), name
            time, course = np.array([0.5, 1.5]), np.array([[0.0, 0.0, -0.1], [0.1, 0.0, -0.1]])
            terms += effect.along(time, course, np.array([-1.0, 0.0]), apparatus)
        assert bool(terms) is not (effect.family is Family.SEEN), name
        for term in terms[:3]:
            assert (effect.resting(term) is not None) is (effect.family is Family.METAL_AT_REST)
            assert (effect.body(term) is not None) is (effect.family is Family.MOVING_METAL)
            assert (effect.opened(term) is not None) is (effect.family is Family.FLUCTUATION)
            assert effect.covers(term, term), name
            assert term.complexity >= term.theta.size
            assert term.free().seat == term.hold().seat
        assert np.isinf(effect.inexact) is np.bool_(effect.family.is_metal), name
        assert not effect.drifts or effect.remedy is Remedy.FLUX, name


def test_a_fluctuation_is_a_rival_of_what_is_steady_on_its_coil(scenery):
    apparatus, effects = scenery[1].apparatus, all_effects()
    free = effects['coil_fluctuation'].candidates(apparatus)
    steady = {name: effects[name].candidates(apparatus) for name in ('coil_gain', 'coil_drift')}
    for terms in steady.values():
        assert free[1].effect.rivals(free[1], terms[1])
        assert not free[1].effect.rivals(free[1], terms[0])
    assert free[1].effect.covers(free[1], steady['coil_gain'][1])
    assert not free[1].effect.covers(free[1], steady['coil_drift'][1])
    assert not free[1].effect.rivals(free[1], free[1])


def test_an_effect_nobody_wrote_is_refused():
    with pytest.raises(ModelFileError, match='no effect is called'):
        effect_named('gremlin')


def test_derivatives_agree_with_differences(scenery):
    _, problem = scenery
    tool, fields = problem.tools[0], problem.fields
    for start in _candidates(problem.apparatus):
        term = _in_force(start)
        view = tool_view(tool, [term], fields)
        columns = term.effect.columns(term, view)
        step = 1e-4 * np.maximum(np.abs(term.theta), 1e-3)
        if term.effect.name in ('conductive_plate', 'static_metal', 'moving_metal'):
            step = np.full(term.theta.size, 1e-4)
        for i in range(term.theta.size):
            sides = []
            for sign in (1, -1):
                theta = term.theta.copy()
                theta[i] += sign * step[i]
                sides.append(tool_view(tool, [term.with_theta(theta)], fields).flux)
            wanted = (sides[0] - sides[1]) / (2 * step[i])
            if columns is None:
                assert not np.abs(wanted).max() > 0, f'{term.label} acts on references only'
                continue
            scale = np.abs(wanted).max() + 1e-30
            error = np.abs(columns[..., i] - wanted).max() / scale
            assert error < 0.05, f'{term.label} parameter {i}: {error:.3g}'


def test_reference_derivatives_agree_with_differences(scenery):
    _, problem = scenery
    references = problem.references
    for start in _candidates(problem.apparatus):
        term = _in_force(start)
        if term.effect.name in ('coil_moved', 'saturation'):
            continue
        view = reference_view(references.readings, references.baseline, [term], problem.fields)
        columns = term.effect.columns(term, view)
        for i in range(term.theta.size):
            theta = term.theta.copy()
            theta[i] += 1e-5
            other = reference_view(
                references.readings, references.baseline, [term.with_theta(theta)], problem.fields
            )
            wanted = (other.flux - view.flux) / 1e-5
            if columns is None:
                assert not np.abs(wanted).max() > 0
                continue
            scale = np.abs(wanted).max() + 1e-30
            assert np.abs(columns[..., i] - wanted).max() / scale < 0.05, term.label


def test_records_give_the_same_term_back(scenery):
    _, problem = scenery
    for start in _candidates(problem.apparatus):
        term = _in_force(start)
        record = term.effect.record(term, 1e-6 * np.eye(term.theta.size))
        again = term.effect.term(record)
        one = tool_view(problem.tools[0], [term], problem.fields).flux
        other = tool_view(problem.tools[0], [again], problem.fields).flux
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-15, err_msg=term.label)


def test_a_correction_undoes_its_effects(scenery):
    made, problem = scenery
    tool = problem.tools[0]
    plain = tool_view(tool, [], problem.fields)
    terms = [
        _in_force(t)
        for t in _candidates(problem.apparatus)
        if t.effect.remedy is Remedy.FLUX and 'mutual' not in t.site
    ]
    terms.append(Term(effect_named('sensor_polarity'), {'channels': (1, 4)}))
    records = [t.effect.record(t, 1e-8 * np.eye(t.theta.size)) for t in terms]
    correction = Correction.of(records, tool.sensors, made.model.frequencies_hz)
    assert correction.changes_flux
    seen = tool_view(tool, correction.terms, problem.fields).flux
    assert np.abs(seen - plain.flux).max() > 1e-8
    for frame in (0, 20, 50):
        time, channels = float(tool.time[frame]), tool.sensors.channel
        back = correction.flux(time, channels, seen[frame], recorded=True)
        np.testing.assert_allclose(back, plain.flux[frame], rtol=1e-5, atol=1e-13)


def test_a_correction_keeps_missing_readings_missing(scenery):
    made, problem = scenery
    record = EffectRecord('sensor_gain', {'channel': 0, 'gain': 2.0})
    correction = Correction.of([record], problem.tools[0].sensors, made.model.frequencies_hz)
    flux = np.ones((2, 4), dtype=complex)
    flux[1] = np.nan
    back = correction.flux(0.0, np.array([0, 1]), flux)
    np.testing.assert_allclose(back[0], 0.5)
    assert np.isnan(back[1]).all()
    nothing = Correction.of([], problem.tools[0].sensors, made.model.frequencies_hz)
    assert nothing.flux(0.0, np.array([0, 1]), flux) is flux


def test_a_drift_is_left_alone_where_nothing_tells_its_course(scenery):
    made, problem = scenery
    record = EffectRecord('coil_drift', {'coil': 2, 'amount': 0.5, 'tau_s': 1.0})
    correction = Correction.of([record], problem.tools[0].sensors, made.model.frequencies_hz)
    flux = np.ones((1, 4), dtype=complex)
    np.testing.assert_array_equal(correction.flux(100.0, np.array([0]), flux), flux)
    back = correction.flux(100.0, np.array([0]), flux, recorded=True)
    np.testing.assert_allclose(back[0], [1.0, 1.0, 1 / 1.5, 1.0])
    assert correction.drifting == ('coil_drift (coil 2)',)


def test_sensors_and_track_are_corrected(scenery):
    made, problem = scenery
    tool = problem.tools[0]
    records = [
        EffectRecord('lever_arm', {'body': 'tool', 'offset_m': [1e-3, 0.0, 0.0]}),
        EffectRecord('sensor_axis', {'channels': [0, 1, 2], 'rotation_deg': [0.0, 0.0, 90.0]}),
        EffectRecord('time_offset', {'offset_s': 0.5}),
        EffectRecord(
            'registration', {'rotation_deg': [0.0, 0.0, 90.0], 'translation_m': [0.0, 0.0, 0.1]}
        ),
    ]
    correction = Correction.of(records, tool.sensors, made.model.frequencies_hz)
    table = correction.sensors()
    np.testing.assert_allclose(table.position[:, 0], 1e-3)
    np.testing.assert_allclose(table.axis[0], [0.0, 1.0, 0.0], atol=1e-12)
    track = correction.optical(tool.track)
    np.testing.assert_allclose(track.time, tool.track.time + 0.5)
    x, y, z = tool.track.position[0]
    np.testing.assert_allclose(track.position[0], [y, -x, z - 0.1], atol=1e-12)


@pytest.mark.parametrize(
    ('name', 'parameters', 'rule'),
    [
        ('sensor_gain', {'channel': 1}, "lacks 'gain'"),
        ('channel_crosstalk', {'channels': [0, 1], 'matrix': [[1.0]]}, 'has a matrix'),
        (
            'sensor_axis',
            {'channel': 0, 'axis': [-1.0, 0, 0], 'surveyed_axis': [1.0, 0, 0]},
            'right angle',
        ),
    ],
)
def test_a_broken_record_is_refused(scenery, name, parameters, rule):
    made, problem = scenery
    with pytest.raises(ModelFileError, match=rule):
        Correction.of(
            [EffectRecord(name, parameters)], problem.tools[0].sensors, made.model.frequencies_hz
        )


def test_compression_keeps_small_signals_and_meets_its_third_order():
    rng = np.random.default_rng(1)
    flux = 1e-7 * (rng.normal(size=(3, 4)) + 1j * rng.normal(size=(3, 4)))
    small = compressed(flux, 1.0, 'tanh')
    np.testing.assert_allclose(small, flux, rtol=1e-12)
    one = np.array([[0.3 + 0j]])
    # A single tone: the first harmonic of tanh, by quadrature.
    phase = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    wanted = 2 * np.mean(np.tanh(0.3 * np.cos(phase)) * np.cos(phase))
    assert compressed(one, 1.0, 'tanh')[0, 0].real == pytest.approx(wanted, rel=1e-6)


def test_a_large_perfect_sheet_is_a_mirror():
    source = Dipoles(
        np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([[1.0 + 0j]])
    )
    sheet = sheet_sources(
        np.array([0.0, 0.0, -0.1]), np.array([0.9, 0.9]), 1e-9, 36, source, np.array([4e4])
    )
    image = Dipoles(np.array([[0.0, 0.0, -0.2]]), source.directions, -source.moments)
    points = np.array([[0.0, 0.0, 0.1], [0.05, 0.0, 0.12]])
    np.testing.assert_allclose(sheet.field(points)[:, 2], image.field(points)[:, 2], rtol=0.03)


@pytest.mark.parametrize('made', [_moving, _visiting])
def test_moving_metal_is_where_it_says(scenery, made):
    _, problem = scenery
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
def test_a_body_answers_alike_whoever_asks(scenery, kind):
    """Modes, couplings and plain dipoles give one flux; sensor and emitter may change places."""
    shapes = BODIES[kind]()
    rng = np.random.default_rng(5)
    couplings = rng.normal(size=shapes.size) + 1j * rng.normal(size=shapes.size)
    centre, omega = np.array([0.01, 0.02, -0.1]), 2e4 * np.pi * np.array([0.9, 1.0])
    places = rng.uniform(-0.1, 0.1, size=(2, 3)) + [0.0, 0.0, 0.25]
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    emitters = Dipoles(places, axes, np.eye(2).astype(complex))
    sources = shapes.sources(centre, couplings, emitters, omega)
    plain = sources.flux(places, axes, None)
    ears = shapes.heard(centre, places, axes, np.zeros(2))
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
    emitters = Dipoles(
        np.concatenate([rng.uniform(-0.1, 0.1, size=(6, 2)), np.zeros((6, 1))], axis=1),
        np.tile([0.0, 0.0, 1.0], (6, 1)),
        np.eye(6).astype(complex),
    )
    field = emitters.field(centre + balls).transpose(0, 2, 1)
    alpha = np.full(len(balls), -2 * np.pi * 0.0043**3 / MU_0 * (1 + 0.1j))
    moments = induced_moments(centre + balls, alpha, field)
    sources = Dipoles.vectors(centre + balls, moments.transpose(0, 2, 1))
    places = np.concatenate(
        [rng.uniform(-0.12, 0.12, (150, 2)), rng.uniform(0.1, 0.2, (150, 1))], axis=1
    )
    axes = rng.normal(size=(150, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    wanted = sources.flux(places, axes, None)
    shapes = multipoles()
    ears = shapes.heard(centre, places, axes, np.zeros(150))
    drive = shapes.driven(emitters.field(centre + shapes.offsets))
    unit = shapes.mode_flux(ears, drive, np.eye(shapes.size), np.full(6, 4e4))
    unit = (unit * body_spread(0.04, 1.0)).reshape(-1, shapes.size)
    normal = unit.T @ unit
    normal += 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal))
    solution = np.linalg.solve(normal, unit.T @ wanted.ravel())
    left = unit @ solution - wanted.ravel()
    assert np.linalg.norm(left) < 3e-3 * np.linalg.norm(wanted)


def test_the_place_of_metal_is_no_surer_than_its_shape(scenery):
    """Of a ball's strength, however little the data scatter."""
    radius = 0.04
    ball = -2 * np.pi * radius**3 * np.eye(3).astype(complex)
    assert centre_sigma(ball) == pytest.approx(ODD * radius)
    _, problem = scenery
    found = {term.effect.name: term for term in _candidates(problem.apparatus)}
    for name, keys in (('static_metal', ['position_m']), ('moving_metal', ['start_m', 'path'])):
        term = _in_force(found[name])
        record = term.effect.record(term, np.zeros((term.theta.size, term.theta.size)))
        total = np.array(record.parameters['polarizability']) @ [1.0, 1.0j]
        for key in keys:
            assert np.min(record.uncertainty[key]) >= centre_sigma(total) > 1e-3


@pytest.mark.parametrize('metal', ['static_metal', 'conductive_plate', 'moving_metal'])
def test_a_coil_that_moved_lights_metal_from_where_it_is(scenery, metal):
    """The same as metal in a world that has the coil there from the start."""
    _, problem = scenery
    tool, fields = problem.tools[0], problem.fields
    found = {term.effect.name: term for term in _candidates(problem.apparatus)}
    body = _in_force(found[metal])
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


def test_leftovers_are_linear_and_belong_to_their_metal(scenery):
    _, problem = scenery
    found = next(t for t in _candidates(problem.apparatus) if t.effect.name == 'static_metal')
    parent = _in_force(found)
    shapes = multipoles()
    rng = np.random.default_rng(0)
    modes = 0.1 * rng.normal(size=(shapes.size, 4))
    view = tool_view(problem.tools[0], [], problem.fields)
    for leftover in (
        Couplings(shapes, parent.theta[:3], modes),
        Lighting([parent], problem.apparatus.emitters),
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


def test_lighting_is_an_emitter_that_sits_higher(scenery):
    """A metal that sees one emitter 0.4 mm higher, told by another illumination."""
    _, problem = scenery
    found = next(t for t in _candidates(problem.apparatus) if t.effect.name == 'static_metal')
    parent = _in_force(found)
    view = tool_view(problem.tools[0], [], problem.fields)
    light = view.illumination
    lighting = Lighting([parent], problem.apparatus.emitters)
    column = lighting.columns(view)[..., 3 * problem.apparatus.emitters + 1]
    higher = replace(light, positions=light.positions + [0.0, 0.0, UP_M])
    both = [
        parent.effect.sources(parent, i, i, view.omega).flux(*view.flat) for i in (higher, light)
    ]
    wanted = view.along(both[0] - both[1])[..., 1]
    np.testing.assert_allclose(column[..., 1], wanted, atol=0.01 * np.abs(wanted).max())
    assert not np.any(column[..., [0, 2]])


def test_the_base_effect_changes_nothing(scenery):
    _, problem = scenery
    tool = problem.tools[0]
    term = Term(Effect())
    view = tool_view(tool, [term], problem.fields)
    np.testing.assert_array_equal(view.flux, tool_view(tool, [], problem.fields).flux)
    assert replace(term, site={'channel': 3}).label == ' (channel 3)'
