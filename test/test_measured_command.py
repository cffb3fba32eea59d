"""The command `anser measured`: usage, table and JSON."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from anser_ros.cli import measured
from anser_ros.cli.main import main
from anser_ros.measured import ReportRow

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get('ANSER_SHARED', ROOT.parent / 'shared'))


def test_unknown_data_set_and_missing_folder(capsys, tmp_path):
    assert main(['measured', 'nothing']) == 2
    assert 'no data set' in capsys.readouterr().err
    assert main(['measured', 'anser_board', '--shared', str(tmp_path)]) == 2
    assert 'no measured data' in capsys.readouterr().err


def test_numbers_that_are_missing_are_null():
    row = ReportRow('set', 'figure', np.nan, np.float64(1.5), 'mm', None, None, 'nothing')
    document = measured.to_document([row])
    assert document['rows'][0]['before'] is None
    assert json.loads(json.dumps(document))['rows'][0]['after'] == 1.5
    assert measured.table([row]).row_count == 1


@pytest.mark.skipif(not (SHARED / 'measured').is_dir(), reason='no shared measured data')
def test_json_alone_on_stdout(capsys, tmp_path):
    code = main(
        ['measured', 'anser_board', '--json', '--out', str(tmp_path), '--shared', str(SHARED)]
    )
    out = capsys.readouterr().out
    assert code == 0
    document = json.loads(out)
    assert document['schema'] == 'anser_measured/1'
    assert {row['dataset'] for row in document['rows']} == {'anser_board'}
    assert (tmp_path / 'anser_board.txt').read_text().startswith('anser_board')
    assert json.loads((tmp_path / 'measured.json').read_text()) == document
