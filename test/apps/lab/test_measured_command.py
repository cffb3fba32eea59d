"""The command `anser measured`: usage, table and JSON."""

import json

import numpy as np
import pytest
from conftest import SHARED, needs
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.cli import measured
from anser_ros.apps.lab.measured import anser_board
from anser_ros.apps.lab.measured.recipe import Recipe, ReportRow
from anser_ros.calibration.error_map import LEAST_GAIN_SIGMAS, learn_error_map
from anser_ros.cli.main import main
from anser_ros.errors import BagError, FitError


def test_unknown_data_set_and_missing_folder(capsys, tmp_path):
    assert main(['measured', 'nothing']) == 2
    assert 'no data set' in capsys.readouterr().err
    assert main(['measured', 'anser_board', '--shared', str(tmp_path)]) == 2
    assert 'no measured data' in capsys.readouterr().err


def test_a_recipe_is_commands_that_anybody_can_type(capsys, tmp_path, monkeypatch):
    (tmp_path / 'measured' / 'set').mkdir(parents=True)
    typed = []

    def run(command):
        typed.append(command)
        print('not shown')
        return 0 if command[0] == 'calibrate' else 2

    def recipe(verb):
        return Recipe(
            'set', lambda folder, into: [into / f'{folder.name}.mcap'],
            lambda bags, out: [[verb, str(bags[0])]],
            lambda folder, bags, out: [
                ReportRow('set', 'figure', 2.0, 1.0, 'mm', 'nothing', 1.1, True, 0.9)
            ],
        )  # fmt: skip

    monkeypatch.setattr(measured.main, 'main', run)
    monkeypatch.setattr(measured, 'RECIPES', {'set': recipe('calibrate')})
    assert main(['measured', 'set', '--shared', str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert typed[0][1].endswith('set.mcap') and '$ anser calibrate' in out
    assert 'not shown' not in out and '0.9 mm' in out
    monkeypatch.setattr(measured, 'RECIPES', {'set': recipe('evaluate')})
    assert main(['measured', 'set', '--shared', str(tmp_path)]) == 2
    assert 'anser evaluate ended with 2' in capsys.readouterr().err


def test_numbers_that_are_missing_are_null():
    row = ReportRow('set', 'figure', np.nan, np.float64(1.5), 'mm', 'nothing')
    document = measured.to_document([row])
    assert document['rows'][0]['before'] is None
    assert json.loads(json.dumps(document))['rows'][0]['after'] == 1.5
    assert measured.table([row]).row_count == 1


@pytest.mark.long
@needs('measured')
def test_json_alone_on_stdout(capsys, tmp_path):
    code = main(
        ['measured', 'anser_board', '--json', '--out', str(tmp_path), '--shared', str(SHARED)]
    )
    out = capsys.readouterr().out
    assert code == 0
    document = json.loads(out)
    assert document['schema'] == 'anser_measured/1'
    assert {row['dataset'] for row in document['rows']} == {'anser_board'}
    assert (tmp_path / 'anser_board' / 'standard_data_grid' / 'error_map.json').is_file()
    assert json.loads((tmp_path / 'measured.json').read_text()) == document


FOLDER = SHARED / 'measured' / 'anser_board'
needs_data = needs('measured', 'anser_board')


def test_broken_lists_are_one_line(tmp_path):
    with pytest.raises(FitError, match='no runs'):
        anser_board.load(tmp_path)
    (tmp_path / 'few.fcsv').write_text('# head\nid,1,2,3\n')
    with pytest.raises(FitError, match=r'few\.fcsv: 41 fiducials expected, got 1'):
        anser_board.load(tmp_path)
    (tmp_path / 'few.fcsv').write_text('id,1,x,3\n')
    with pytest.raises(BagError, match='no table of fiducials'):
        anser_board.load(tmp_path)


@pytest.mark.long
def test_a_bent_run_gains_and_a_scattered_one_does_not(tmp_path):
    rng, there = np.random.default_rng(11), anser_board.places()
    turn = Rotation.from_rotvec([0.4, -1.0, 0.3])
    runs = {'bent': there * [1.04, 0.97, 1.0], 'scattered': there}
    for name, points in runs.items():
        told = 1e3 * (turn.apply(points + 1e-3 * rng.normal(size=points.shape)) + 0.2)
        lines = [f'id{i},{x:.3f},{y:.3f},{z:.3f}' for i, (x, y, z) in enumerate(told)]
        (tmp_path / f'{name}.fcsv').write_text('\n'.join(lines))
    files = anser_board.write_sessions(tmp_path, tmp_path / 'files')
    for command in anser_board.commands(files, tmp_path / 'out'):
        assert main(command) == 0
    rows = anser_board.rows(tmp_path, files, tmp_path / 'out')
    errors, gains = rows[::2], [row.after for row in rows[1::2]]
    words = {row.figure.split(':')[0]: row.chosen_on for row in errors}
    assert ': a gain' in words['bent'] and 'no gain is shown' in words['scattered']
    assert all('across the board, not corrected' in row.chosen_on for row in errors)
    assert gains[0] > LEAST_GAIN_SIGMAS > gains[1]


@pytest.mark.long
@needs_data
def test_of_the_measured_runs_one_has_an_error_to_map():
    found = {
        name: learn_error_map(points, anser_board.places(), registers=True)
        for name, points in anser_board.load(FOLDER).items()
        if name in ('standard_data_grid', 'steel_shield', 'finer_mesh_points')
    }
    assert [name for name, one in found.items() if one.is_confirmed] == ['standard_data_grid']
    assert 1e3 * found['standard_data_grid'].before.judged == pytest.approx(2.27, abs=0.01)
    assert 1e3 * found['standard_data_grid'].after.judged < 1.5
    for one in found.values():
        assert one.after.out_of_plane == pytest.approx(one.before.out_of_plane, rel=0.02)
