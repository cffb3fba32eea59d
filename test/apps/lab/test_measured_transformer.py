"""The field before a transformer as sessions: which points are taken, and in which frame."""

import json

import numpy as np
import pytest
from conftest import SHARED, needs

from anser_ros.apps.lab.measured import transformer
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import save_model

FOLDER = SHARED / 'measured' / 'transformer'
MOMENT = np.array([20.0 + 5.0j, -8.0j, 60.0])
"""Of a dipole at the data set's (0, 0, 1), A m^2, along its axes."""


def dipole_field(away, moment):
    """Field (T) of a dipole at places (P, 3) away from it."""
    distance = np.linalg.norm(away, axis=1)[:, None]
    along = (away @ moment)[:, None] / distance**2
    return 1e-7 * (3 * along * away - moment) / distance**3


def written(folder):
    """A file of the published form with the field of one dipole; the places."""
    grid = np.meshgrid(
        0.1 * np.arange(5, 11), 0.1 * np.arange(-5, 6), 0.1 * np.arange(21), indexing='ij'
    )
    place = np.stack(grid, axis=-1).reshape(-1, 3)
    field = dipole_field(place - [0.0, 0.0, 1.0], MOMENT)
    table = np.hstack([place, field.real, field.imag])
    np.savetxt(folder / 'data_set.txt', table, header='columns', comments='%')
    return place


def test_measured_planes_become_sessions_in_the_frame_of_the_transformer(tmp_path):
    written(tmp_path)
    planes, kept = map(load_session, transformer.write_sessions(tmp_path, tmp_path / 'bags'))
    # 11 x 21 points on a fine plane, and every second each way on the farthest.
    assert len(planes.tools[0].time) == 2 * 231 + 6 * 11 and len(kept.tools[0].time) == 231
    for session, heights in ((planes, [0.5, 0.6, 1.0]), (kept, [0.8])):
        (tool,) = session.tools
        np.testing.assert_allclose(np.unique(tool.position[:, 2].round(6)), heights)
        # The data's axes x, y, z are z, x, y of fg.
        want = dipole_field(tool.position, np.roll(MOMENT, -1))
        np.testing.assert_allclose(tool.flux[:, :, 0], want, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(
    ('text', 'said'), [('1 2 3\n', '3 columns, expected 9'), ('a b\n', 'data_set.txt: could not')]
)
def test_a_file_of_another_form_is_refused(tmp_path, text, said):
    (tmp_path / 'data_set.txt').write_text(text)
    with pytest.raises(FitError, match=said):
        transformer.read(tmp_path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FitError, match='no such file'):
        transformer.read(tmp_path)


def test_rows_compare_the_model_with_an_interpolation_on_the_plane_left_out(tmp_path):
    written(tmp_path)
    bags = transformer.write_sessions(tmp_path, tmp_path / 'bags')
    moments = np.roll(MOMENT, -1)[:, None]
    dipole = FieldModel(np.zeros((3, 3)), np.eye(3), moments, (transformer.NAME,), (50.0,))
    save_model(tmp_path / 'model.yaml', dipole)
    (tmp_path / 'diagnosis').mkdir()
    (tmp_path / 'diagnosis' / 'diagnosis.json').write_text(json.dumps({'effects': []}))
    field, named = transformer.rows(tmp_path, bags, tmp_path)
    # The file's own dipole predicts it; linear in between is far off.
    assert field.after < 1e-4 and field.before > 0.1
    assert named.after == 0


@needs('measured', 'transformer')
def test_the_published_file_has_the_planes(tmp_path):
    place, field = transformer.read(FOLDER)
    assert len(place) == 3 * 231 + 66 and np.abs(field).max() < 1e-3
