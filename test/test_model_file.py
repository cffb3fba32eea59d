"""Model files: written whole, read back the same, refused with the rule named."""

from dataclasses import replace

import numpy as np
import pytest

from anser_ros.cli.sessions import snapshot_notes
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord, FieldModel, from_document, to_document
from anser_ros.sessions.starting_model import as_saved, is_snapshot, load_model, save_model


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
        ({'shift_sigma_m': 'far'}, 'shift_sigma_m is malformed'),
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
    with pytest.raises(ModelFileError, match=r'broken\.yaml'):
        load_model(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ModelFileError, match=r'absent\.yaml'):
        load_model(tmp_path / 'absent.yaml')


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
