"""The command `anser measured`: usage, table and JSON."""

import json

import numpy as np
import pytest
from conftest import SHARED, needs

from anser_ros.apps.lab.cli import measured
from anser_ros.apps.lab.measured.recipe import Recipe, ReportRow
from anser_ros.cli.main import main as measured_main


def test_unknown_data_set_and_missing_folder(capsys, tmp_path):
    assert measured_main(['measured', 'nothing']) == 2
    assert 'no data set' in capsys.readouterr().err
    assert measured_main(['measured', 'anser_board', '--shared', str(tmp_path)]) == 2
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
    assert measured_main(['measured', 'set', '--shared', str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert typed[0][1].endswith('set.mcap') and '$ anser calibrate' in out
    assert 'not shown' not in out and '0.9 mm' in out
    monkeypatch.setattr(measured, 'RECIPES', {'set': recipe('evaluate')})
    assert measured_main(['measured', 'set', '--shared', str(tmp_path)]) == 2
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
    code = measured_main(
        ['measured', 'anser_board', '--json', '--out', str(tmp_path), '--shared', str(SHARED)]
    )
    out = capsys.readouterr().out
    assert code == 0
    document = json.loads(out)
    assert document['schema'] == 'anser_measured/1'
    assert {row['dataset'] for row in document['rows']} == {'anser_board'}
    assert (tmp_path / 'anser_board' / 'standard_data_grid' / 'error_map.json').is_file()
    assert json.loads((tmp_path / 'measured.json').read_text()) == document
