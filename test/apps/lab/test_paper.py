"""The article's experiments on small recordings of our own simulator."""

import json

import numpy as np
import pytest

from anser_ros.apps.lab.experiments import recordings as article
from anser_ros.apps.lab.experiments.recordings import (
    HEAD_DISTANCES_CM,
    NAMES,
    checkerboard,
    given_recordings,
    missing,
    simulate_recordings,
)
from anser_ros.apps.lab.experiments.report import draw_all, write_report
from anser_ros.apps.lab.experiments.study import (
    Study,
    article_model,
    board_runs,
    centres_extension,
    drawn_model,
    field_errors,
    position_bound,
    track,
)
from anser_ros.apps.lab.measured import anser_board
from anser_ros.cli.main import main
from anser_ros.errors import BagError


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    return simulate_recordings(tmp_path_factory.mktemp('recordings'), seed=3, share=0.3)


@pytest.fixture(scope='module')
def study(recordings, tmp_path_factory):
    """All experiments, with a run over a board that is made here."""
    shared = tmp_path_factory.mktemp('shared')
    write_run(anser_board.RECIPE.data(shared))
    study = Study(recordings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ANSER_SHARED', str(shared))
        study.run()
    return study


def write_run(folder):
    """A run over the board with bent positions, in a frame of its own."""
    places = anser_board.places()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    tracked = 1e3 * (places + 0.02 * places * np.abs(places)[:, ::-1] / 0.06) @ turn.T + 150.0
    lines = [f'id{i},{x:.4f},{y:.4f},{z:.4f},0' for i, (x, y, z) in enumerate(tracked)]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / 'run.fcsv').write_text('# markups\n' + '\n'.join(lines) + '\n')


def test_every_recording_is_made_and_named(recordings):
    assert missing(recordings.folder) == []
    assert 'own' in recordings.origin
    assert recordings.load('midplane_tool_b').tools[0].sensors.length.tolist() == [0.0082, 0.0082]


def test_a_folder_that_lacks_some_is_refused(tmp_path, capsys):
    with pytest.raises(BagError, match=f'{len(NAMES)} of {len(NAMES)} recordings are missing'):
        given_recordings(tmp_path)
    assert main(['paper', '--sessions', str(tmp_path), '--out', str(tmp_path / 'out')]) == 2
    assert 'factory_tool_a.mcap' in capsys.readouterr().err


def test_the_checkerboard_halves_the_points(recordings):
    session = recordings.shield('aluminium')
    training, test = checkerboard(session)
    counts = [len(part.tools[0].time) for part in (training, test)]
    assert sum(counts) == len(session.tools[0].time)
    assert abs(counts[0] - counts[1]) <= 1
    between = training.tools[0].position[:, None, :2] - test.tools[0].position[None, :, :2]
    assert np.linalg.norm(between, axis=2).min() > 0.01


def test_the_articles_own_method_is_real_least_squares(recordings):
    session = recordings.load('factory_tool_a')
    model = article_model(session)
    assert model.moments.shape == (144, 8)
    assert not model.moments.imag.any()
    assert field_errors(session, model)['N-RMSE'] < 0.1
    assert 0.5 < centres_extension(session) < 1.0


def test_the_drawing_gets_one_gain_an_emitter(recordings):
    session = recordings.load('factory_tool_a')
    model = drawn_model(session)
    assert model.modes is None
    assert model.flux_error_t > 0
    assert field_errors(session, model)['N-RMSE'] < 3.0


@pytest.mark.long
def test_ours_is_near_the_jitter_and_the_article_is_not_better(study):
    tracking = study.results.tracking['table_2']
    for sensor in article.SENSORS:
        ours = tracking['ours'][sensor].millimetres()['RMSE']
        assert ours < 0.145
        assert ours < tracking['article'][sensor].millimetres()['RMSE'] + 0.01
        assert tracking['drawing'][sensor].millimetres()['RMSE'] > 2 * ours
        assert study.results.bounds['table_2'][sensor] < 0.1e-3


@pytest.mark.long
def test_the_head_makes_it_worse_the_nearer_it_is(study):
    errors = [
        study.results.tracking[f'fig_7 {d} cm']['ours']['Y'].millimetres()['RMSE']
        for d in HEAD_DISTANCES_CM
    ]
    assert errors[-1] > 5 * errors[0]
    assert np.argmax(errors) >= len(errors) - 2


@pytest.mark.long
def test_compensation_takes_the_distortion_away(study):
    tracking = study.results.tracking
    for sensor in article.SENSORS:
        bent = tracking['table_5 uncompensated']['ours'][sensor].millimetres()['RMSE']
        straight = tracking['table_5 compensated']['ours'][sensor].millimetres()['RMSE']
        assert straight < 0.3 < bent


@pytest.mark.long
def test_report_and_figures_say_simulated(study, tmp_path):
    figures = draw_all(study, tmp_path)
    write_report(study.results.document(), figures, tmp_path / 'paper.md')
    text = (tmp_path / 'paper.md').read_text()
    for heading in ('Table II', 'Table III', 'Table IV', 'Table V', 'Figures'):
        assert any(heading in line and 'imulated' in line for line in text.split('\n'))
    assert set(figures) == {f'Fig. {n}' for n in (2, 5, 6, 7, 8, 9, 10)}
    for file in figures.values():
        assert f']({file})' in text
        assert (tmp_path / file).read_bytes()[:4] == b'\x89PNG'
    assert 'Cramer-Rao' in text
    assert f'{article.TABLE_2_MM["data-driven"]["Y"]["RMSE"]:.2f}' in text


def test_the_bound_shrinks_with_the_noise(recordings):
    session = recordings.load('midplane_tool_b')
    model = article_model(recordings.load('factory_tool_a'))
    one, two = (position_bound(session.tools[0], model, noise) for noise in (30e-12, 60e-12))
    assert np.allclose(two, 2 * one)
    assert (one > 5e-6).all()


def test_corrected_errors_keep_what_was_not_tracked(recordings):
    session = recordings.load('c_arm_30cm_tool_b')
    found = track(session, article_model(recordings.load('factory_tool_a')), in_phase=True)['Y']
    assert found.document()['tracked_fraction'] == 1.0
    assert np.allclose(found.corrected(found.true).distance, 0.0)


def test_fiducials_are_read_aligned_and_mapped(tmp_path):
    write_run(tmp_path)
    (run,) = board_runs(tmp_path)
    assert run['points'] == 41
    assert run['after_m'] < 0.8 * run['before_m'] and run['confirmed']
    assert run['across_m'] < 1e-5
    assert board_runs(tmp_path / 'nowhere') == []


def test_error_map_command(tmp_path, capsys):
    rng = np.random.default_rng(1)
    true = rng.uniform(-0.1, 0.1, (80, 3))
    tracked = true + 0.002 * np.sin(true / 0.05)
    header = 'x_m,y_m,z_m,true_x_m,true_y_m,true_z_m\n'
    rows = [','.join(f'{v:.7f}' for v in (*t, *r)) for t, r in zip(tracked, true, strict=True)]
    (tmp_path / 'points.csv').write_text(header + '\n'.join(rows) + '\n')
    points = str(tmp_path / 'points.csv')
    arguments = ['error_map', points, '--out', str(tmp_path), '--apply', points, '--json']
    assert main(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    assert document['heldout_rmse_after_m'] < 0.3 * document['heldout_rmse_before_m']
    lines = (tmp_path / 'corrected.csv').read_text().splitlines()
    assert len(lines) == 81
    first = np.array(lines[1].split(','), dtype=float)
    assert np.linalg.norm(first[:3] - true[0]) < 0.5 * np.linalg.norm(tracked[0] - true[0]) + 1e-4
    assert main(['error_map', points, '--out', str(tmp_path)]) == 0
    assert 'held out' in capsys.readouterr().out
    (tmp_path / 'bad.csv').write_text('x_m,y_m\n1,2\n')
    assert main(['error_map', str(tmp_path / 'bad.csv'), '--out', str(tmp_path)]) == 2
    assert 'needs the columns' in capsys.readouterr().err
    (tmp_path / 'none.csv').write_text(header)
    assert main(['error_map', str(tmp_path / 'none.csv'), '--out', str(tmp_path)]) == 2
