"""Model files: written whole, refused with the rule named, and of one board and its tools."""

from dataclasses import replace

import numpy as np
import pytest
from tracking_world import anser_board, certain_model, setup_of, triaxial_tool

from anser_ros.cli.sessions import snapshot_notes
from anser_ros.errors import ModelFileError
from anser_ros.field.model import (
    EffectRecord,
    FieldModel,
    OpenArm,
    ReferenceReadings,
    from_document,
    to_document,
)
from anser_ros.field.nominal import nominal_model
from anser_ros.fingerprint import fingerprint_of
from anser_ros.nodes.streams.clouds import GivenModel
from anser_ros.nodes.tracker_models import ModelReader
from anser_ros.pose_states import code_of
from anser_ros.sessions.starting_model import (
    as_saved,
    check_emitters,
    is_nominal,
    is_snapshot,
    load_model,
    made_for,
    save_model,
)
from anser_ros.wire.points import DipolePoints, ModelError, decode_model_error, encode_model_error
from anser_ros.wire.setup import dump_setup, parse_setup


def model() -> FieldModel:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(6, 3))
    return FieldModel(
        positions=rng.normal(size=(6, 3)),
        directions=directions / np.linalg.norm(directions, axis=1, keepdims=True),
        moments=rng.normal(size=(6, 2)) + 1j * rng.normal(size=(6, 2)),
        emitters=('a', 'b'),
        frequencies_hz=(6000.0, 6200.0),
        flux_error_t=3e-11,
        modes=rng.normal(size=(3, 6, 2)) + 1j * rng.normal(size=(3, 6, 2)),
        effects=(EffectRecord('sensor_gain', {'channel': 2, 'gain': 0.98, 'phase_deg': 0.1}),),
        provenance={'made_by': 'a test', 'heldout_flux_rmse_t': 1e-10},
        shift_sigma_m=2e-5,
    )


def test_a_model_survives_its_file(tmp_path):
    before, path = model(), tmp_path / 'deep' / 'model.yaml'
    save_model(path, before)
    after = load_model(path)
    for name in ('positions', 'directions', 'moments', 'modes'):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert after.effects == before.effects
    assert (after.emitters, after.frequencies_hz) == (before.emitters, before.frequencies_hz)
    assert after.flux_error_t == before.flux_error_t
    assert after.shift_sigma_m == before.shift_sigma_m
    assert after.provenance == before.provenance


def test_added_dipoles_add_their_field():
    a, point, axis = model(), np.array([[0.3, 0.2, 5.0]]), np.array([[0.0, 0.6, 0.8]])
    both = a.with_dipoles(a.positions + 1.0, a.directions, 2 * a.moments)
    moved = FieldModel(
        a.positions + 1.0, a.directions, 2 * a.moments, a.emitters, a.frequencies_hz
    )
    np.testing.assert_allclose(
        both.flux(point, axis), a.flux(point, axis) + moved.flux(point, axis)
    )
    assert both.modes.shape == (3, 12, 2)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'schema': 'other/1'}, 'schema must be'),
        ({'emitters': []}, 'emitters'),
        ({'emitters': [{'name': 'a'}]}, 'malformed'),
        ({'shift_sigma_m': 'far'}, 'shift_sigma_m or open_arms is malformed'),
        ({'open_arms': {'tool': {'sigma_m': 1e-3}}}, 'open_arms is malformed'),
        ({'open_arms': ['tool']}, 'open_arms is malformed'),
        ({'dipoles': [[1, 2]]}, 'rows of 10 numbers'),
        ({'dipoles': 'many'}, 'not a table of numbers|rows of 10'),
        ({'dipoles': [[0.0] * 10]}, 'not a unit vector'),
        ({'dipoles': [[float('nan')] * 10]}, 'not finite'),
        ({'effects': [{'parameters': {}}]}, 'needs a name'),
        ({'effects': {'name': 'x'}}, 'must be a list'),
        ({'effects': [{'name': 'x', 'parameters': [1]}]}, 'mappings of parameters'),
        ({'provenance': ['a test']}, 'provenance must be a mapping'),
        ({'modes': [[[0.0] * 4] * 5]}, 'one row a dipole'),
    ],
)
def test_a_broken_model_is_refused(change, message):
    with pytest.raises(ModelFileError, match=message):
        from_document({**to_document(model()), **change})


@pytest.mark.parametrize('text', ['', '[1, 2', 'a: b: c', '\x00\x01', 'schema: anser_setup/1'])
def test_a_file_that_is_no_model_is_refused_by_name(tmp_path, text):
    path = tmp_path / 'broken.yaml'
    path.write_text(text)
    for name in ('broken.yaml', 'absent.yaml'):
        with pytest.raises(ModelFileError, match=name):
            load_model(tmp_path / name)


def test_a_snapshot_with_metal_in_it_is_no_calibration(tmp_path, capsys):
    base, path = model(), tmp_path / 'saved.yaml'
    metal = base.with_dipoles(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones((1, 2)) + 0j)
    save_model(path, as_saved(replace(base, modes=None), base, 7))
    assert load_model(path).provenance == base.provenance, 'nothing has changed but the error'
    for changed in (metal, replace(base, moments=1.001 * base.moments)):
        save_model(path, as_saved(changed, base, 7))
        with pytest.raises(ModelFileError, match=r'saved\.yaml: a snapshot .*stamp_ns 7.*not a c'):
            load_model(path)
        read = load_model(path, snapshot=True)
        assert is_snapshot(read)
        assert read.provenance['started_from'] == base.provenance
        np.testing.assert_array_equal(read.moments, changed.moments)
    assert snapshot_notes('a file', base) == ()
    (note,) = snapshot_notes('a file', read)
    assert note.startswith('a file is a snapshot of a refit')


def test_shapes_must_fit():
    a = model()
    with pytest.raises(ModelFileError, match='moments'):
        FieldModel(a.positions, a.directions, a.moments[:, :1], a.emitters, a.frequencies_hz)
    with pytest.raises(ModelFileError, match='positions'):
        FieldModel(a.positions[:3], a.directions, a.moments, a.emitters, a.frequencies_hz)


SETUP = setup_of(triaxial_tool())
SENSORS = SETUP.tool_sensors


def gain(channel):
    return EffectRecord('sensor_gain', {'channel': channel, 'gain': 1.02, 'phase_deg': 0.0})


def test_a_fingerprint_is_of_the_content_alone():
    one = {'a': [1, 2.5, 'x', None], 'b': np.array([[1.0, -0.0]])}
    assert fingerprint_of(one) == fingerprint_of(dict(reversed(one.items())))
    assert fingerprint_of([1, 0.1 + 0.2]) == fingerprint_of((1.0, 0.3)), 'a sum of another order'
    assert fingerprint_of([0.3]) != fingerprint_of([0.3 + 1e-9])
    assert fingerprint_of(['ab', 'c']) != fingerprint_of(['a', 'bc'])
    assert fingerprint_of([True]) != fingerprint_of([1])
    assert fingerprint_of(one) == '8e14d3c1', 'the same on every machine and in every version'


def test_a_setup_says_what_it_is_of():
    text = dump_setup(SETUP)
    again = parse_setup(text)
    assert again.identity == SETUP.identity and again.identity.board in text
    faster = replace(SETUP, flux_rate_hz=2 * SETUP.flux_rate_hz)
    assert faster.identity == SETUP.identity
    turned = replace(SENSORS[0], axis=(0.0, 1.0, 0.0), channel=SENSORS[0].channel)
    other = replace(SETUP, sensors=(turned, *SETUP.sensors[1:])).identity
    changed = [
        body for body, known in SETUP.identity.bodies.items() if other.bodies[body] != known
    ]
    assert changed == [SENSORS[0].body] and other.board == SETUP.identity.board


def test_a_model_file_that_was_changed_is_refused_and_an_old_one_is_believed():
    references = ReferenceReadings(
        ('a',), np.zeros((1, 3)), np.eye(3)[:1], np.full((1, 8), 1e-6 + 2e-9j), 1e-12
    )
    model = made_for(replace(certain_model(), references=references), SETUP)
    document = to_document(model)
    back = from_document(document)
    assert back.fingerprint == model.fingerprint and back.made_for == SETUP.identity
    assert back.references.name == ('a',) and back.references.sigma_t == 1e-12
    np.testing.assert_array_equal(back.references.flux, references.flux)
    louder = [[*row[:6], *(1.01 * np.array(row[6:]))] for row in document['dipoles']]
    document['dipoles'] = louder
    with pytest.raises(ModelFileError, match=f'{model.fingerprint}, but its content has'):
        from_document(document)
    for key in ('fingerprint', 'made_for', 'references'):
        del document[key]
    assert from_document(document).made_for is None
    for key, value in (('made_for', 3), ('references', {'sensors': 5})):
        with pytest.raises(ModelFileError, match=key):
            from_document({**document, key: value})


def test_a_model_of_another_board_or_tool_is_refused_with_both_named():
    model = made_for(certain_model(), SETUP)
    check_emitters(SETUP, model)
    coils = SETUP.emitter.coils
    moved = replace(coils[0], centre_m=(0.0, 0.0, 0.001))
    board = replace(SETUP, emitter=replace(SETUP.emitter, coils=(moved, *coils[1:])))
    named = f'{SETUP.identity.board}.*{board.identity.board}'
    with pytest.raises(ModelFileError, match=named):
        check_emitters(board, model)
    longer = replace(SENSORS[0], length_m=0.02)
    tool = replace(SETUP, sensors=(longer, *SETUP.sensors[1:]))
    check_emitters(tool, model)  # the field is the same for every tool
    with pytest.raises(ModelFileError, match=tool.identity.bodies[longer.body]):
        check_emitters(tool, replace(model, effects=(gain(longer.channel),)))
    check_emitters(tool, made_for(replace(model, effects=(gain(longer.channel),)), tool))


@pytest.mark.parametrize(
    ('own', 'served', 'effects', 'state'),
    [(0, 0, 1, ''), (0, 1, 0, 'other_model'), (None, 0, 0, ''), (None, 1, 1, 'other_model'),
     (0, None, 0, '')],
)  # fmt: skip
def test_dipoles_and_effects_have_to_be_of_one_model(own, served, effects, state):
    models = [certain_model(), replace(certain_model(), effects=(gain(0),))]
    file_model = None if own is None else models[own]
    reader = ModelReader(SETUP, file_model, 'mine')
    told = '' if served is None else models[served].fingerprint
    error = ModelError(0.0, np.zeros((0, 1, 8), complex), fingerprint=told, effects=effects)
    given = GivenModel(
        5, DipolePoints(*(getattr(models[0], n) for n in ('positions', 'directions',
                                                               'moments'))), error
    )  # fmt: skip
    withheld = reader.answer(given).withheld
    assert (withheld.state if withheld else '') == state
    if state:
        assert told in withheld.reason


def test_an_uncertainty_that_names_no_model_is_read_as_before():
    modes = np.ones((1, 2, 3), complex)
    fields, step, data = encode_model_error(ModelError(1e-12, modes, True, 2, '00c0ffee', 4))
    back = decode_model_error(fields, step, len(data) // step, data, 2, 3)
    assert (back.fingerprint, back.effects) == ('00c0ffee', 4)
    short = b''.join(data[i : i + step - 8] for i in range(0, len(data), step))
    old = decode_model_error(fields[:-2], step - 8, len(data) // step, short, 2, 3)
    assert (old.fingerprint, old.effects, old.withheld) == ('', 0, 2)
    np.testing.assert_array_equal(old.modes, modes)


@pytest.mark.parametrize(('allowed', 'state'), [(False, 'uncalibrated'), (True, '')])
def test_the_drawing_gives_poses_only_where_it_may(allowed, state):
    model = certain_model()
    reader = ModelReader(SETUP, None, 'mine', allowed)
    error = ModelError(0.0, np.zeros((0, 1, 8), complex), withheld=code_of('uncalibrated'))
    points = DipolePoints(model.positions, model.directions, model.moments)
    given = GivenModel(5, points, error)
    withheld = reader.answer(given).withheld
    assert (withheld.state if withheld else '') == state
    drawn = nominal_model(anser_board())
    assert is_nominal(drawn) and is_nominal(from_document(to_document(drawn)))
    assert not is_nominal(model)


def test_a_model_keeps_its_name_from_before_axes_were_open():
    """A file of then states this fingerprint, and would be refused with another."""
    arm = OpenArm(0.004, np.eye(3))
    model = FieldModel(
        np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones((1, 1), complex), ('a',),
        (1000.0,), open_arms={'tool': arm},
    )  # fmt: skip
    assert model.fingerprint == 'dc628230'
    turned = replace(model, open_arms={'tool': replace(arm, axes_rad=0.01)})
    assert turned.fingerprint != 'dc628230'
