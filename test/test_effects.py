"""Effects: every derivative against differences, every correction against its forward model."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import world
from effects_scene import candidates, in_force, undrawn
from tracking_world import three_axis

from anser_ros.diagnosis.engine import is_covered
from anser_ros.effects.channels import compressed
from anser_ros.effects.correction import Correction, reference_view, tool_view
from anser_ros.effects.effect import Family, Remedy, Term, all_effects, effect_named
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord


@pytest.fixture(scope='module')
def problem():
    made = world(frames=60)
    made.track(made.true_track)
    return made.problem()


def corrected(problem, *records):
    frequencies = problem.fields.omega / (2 * np.pi)
    return Correction.of(records, problem.tools[0].sensors, frequencies)


def test_effects_declare_what_the_search_needs(problem):
    """Whoever adds an effect of a family must give what that family is refined with."""
    apparatus = problem.apparatus
    array = three_axis('array', 0.05 * np.random.default_rng(1).normal(size=(13, 3)), 1000)
    apparatus = replace(undrawn(apparatus), tools=(*apparatus.tools, array))
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
            assert term.free().name_and_site == term.hold().name_and_site
        assert np.isinf(effect.inexact) is np.bool_(effect.family.is_metal), name
        assert not effect.drifts or effect.remedy is Remedy.FLUX, name


def test_a_fluctuation_is_a_rival_of_what_is_steady_on_its_coil(problem):
    apparatus, effects = problem.apparatus, all_effects()
    free = effects['coil_fluctuation'].candidates(apparatus)
    steady = {name: effects[name].candidates(apparatus) for name in ('coil_gain', 'coil_drift')}
    for terms in steady.values():
        assert free[1].effect.rivals(free[1], terms[1])
        assert not free[1].effect.rivals(free[1], terms[0])
    assert free[1].effect.covers(free[1], steady['coil_gain'][1])
    assert not free[1].effect.covers(free[1], steady['coil_drift'][1])
    assert not free[1].effect.rivals(free[1], free[1])


def test_an_axis_is_looked_for_beside_a_scale_of_all(problem):
    """One axis that is far off makes most of what a scale and a shift make."""
    of_all, *axes = all_effects()['optical_scale'].candidates(problem.apparatus)
    assert len(axes) == 3 and not any(is_covered(axis, [of_all]) for axis in axes)
    assert is_covered(of_all.with_theta([0.01, 0.0, 0.0, 0.0]), [of_all])


def test_an_effect_nobody_wrote_is_refused():
    with pytest.raises(ModelFileError, match='no effect is called'):
        effect_named('gremlin')


def agree(term, step, predicted):
    """Compare a term's columns with central differences of the predicted flux."""
    columns = term.effect.columns(term, predicted(term))
    for i, one in enumerate(np.diag(step)):
        more, less = (predicted(term.with_theta(term.theta + s)).flux for s in (one, -one))
        wanted = (more - less) / (2 * step[i])
        if columns is None:
            assert not np.abs(wanted).max() > 0, f'{term.label} acts elsewhere only'
            continue
        error = np.abs(columns[..., i] - wanted).max() / (np.abs(wanted).max() + 1e-30)
        assert error < 0.05, f'{term.label} parameter {i}: {error:.3g}'


@pytest.mark.long
def test_derivatives_agree_with_differences(problem):
    tool, fields = problem.tools[0], problem.fields
    for start in candidates(problem.apparatus):
        term = in_force(start)
        step = 1e-4 * np.maximum(np.abs(term.theta), 1e-3)
        if term.effect.name in ('conductive_plate', 'static_metal', 'moving_metal'):
            step = np.full(term.theta.size, 1e-4)
        agree(term, step, lambda term: tool_view(tool, [term], fields))


def test_reference_derivatives_agree_with_differences(problem):
    known, fields = problem.references, problem.fields
    for start in candidates(problem.apparatus):
        term = in_force(start)
        if term.effect.name not in ('coil_moved', 'coil_turned', 'saturation'):
            step = np.full(term.theta.size, 1e-5)
            agree(
                term, step, lambda t: reference_view(known.readings, known.baseline, [t], fields)
            )


def test_records_give_the_same_term_back(problem):
    for start in candidates(problem.apparatus):
        term = in_force(start)
        record = term.effect.record(term, 1e-6 * np.eye(term.theta.size))
        again = term.effect.term(record)
        one = tool_view(problem.tools[0], [term], problem.fields).flux
        other = tool_view(problem.tools[0], [again], problem.fields).flux
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-15, err_msg=term.label)


def test_a_correction_undoes_its_effects(problem):
    tool = problem.tools[0]
    plain = tool_view(tool, [], problem.fields)
    terms = [
        in_force(t)
        for t in candidates(problem.apparatus)
        if t.effect.remedy is Remedy.FLUX and 'mutual' not in t.site
    ]
    terms.append(Term(effect_named('sensor_polarity'), {'channels': (1, 4)}))
    records = [t.effect.record(t, 1e-8 * np.eye(t.theta.size)) for t in terms]
    correction = corrected(problem, *records)
    assert correction.changes_flux
    seen = tool_view(tool, correction.terms, problem.fields).flux
    assert np.abs(seen - plain.flux).max() > 1e-8
    for frame in (0, 20, 50):
        time, channels = float(tool.time[frame]), tool.sensors.channel
        back = correction.flux(time, channels, seen[frame], recorded=True)
        np.testing.assert_allclose(back, plain.flux[frame], rtol=1e-5, atol=1e-13)


def test_a_correction_leaves_missing_readings_and_a_drift_without_a_course_alone(problem):
    record = EffectRecord('sensor_gain', {'channel': 0, 'gain': 2.0})
    correction = corrected(problem, record)
    flux = np.ones((2, 4), dtype=complex)
    flux[1] = np.nan
    back = correction.flux(0.0, np.array([0, 1]), flux)
    np.testing.assert_allclose(back[0], 0.5)
    assert np.isnan(back[1]).all()
    assert corrected(problem).flux(0.0, np.array([0, 1]), flux) is flux
    record = EffectRecord('coil_drift', {'coil': 2, 'amount': 0.5, 'tau_s': 1.0})
    correction = corrected(problem, record)
    flux = np.ones((1, 4), dtype=complex)
    np.testing.assert_array_equal(correction.flux(100.0, np.array([0]), flux), flux)
    back = correction.flux(100.0, np.array([0]), flux, recorded=True)
    np.testing.assert_allclose(back[0], [1.0, 1.0, 1 / 1.5, 1.0])
    assert correction.drifting == ('coil_drift (coil 2)',)


def test_sensors_and_track_are_corrected(problem):
    tool = problem.tools[0]
    records = [
        EffectRecord('lever_arm', {'body': 'tool', 'offset_m': [1e-3, 0.0, 0.0]}),
        EffectRecord('sensor_axis', {'channels': [0, 1, 2], 'rotation_deg': [0.0, 0.0, 90.0]}),
        EffectRecord('time_offset', {'offset_s': 0.5}),
        EffectRecord(
            'registration', {'rotation_deg': [0.0, 0.0, 90.0], 'translation_m': [0.0, 0.0, 0.1]}
        ),
    ]
    correction = corrected(problem, *records)
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
            {'channel': 0, 'axis': [-1, 0, 0], 'surveyed_axis': [1, 0, 0]},
            'right angle',
        ),
    ],
)
def test_a_broken_record_is_refused(problem, name, parameters, rule):
    with pytest.raises(ModelFileError, match=rule):
        corrected(problem, EffectRecord(name, parameters))


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
