"""The scripts of examples/ run as they stand, and say what their first lines promise."""

import runpy
import sys

import pytest
from conftest import REPO

EXAMPLES = REPO / 'examples'
SAID = {
    'own_data': 'model error on held-out places',
    'track_and_plot': '100% of 200 frames tracked',
    'find_an_effect': "sensor_gain {'channel': 4",
    'own_board': 'calibrated: 9',
    'batch': 'moving.mcap: 100% of 200 frames tracked',
}


# A whole diagnosis or calibration: some ten seconds on a quiet machine, a minute on a busy one.
SLOW = pytest.mark.long
LONG = ('find_an_effect', 'own_board', 'own_data')
NAMES = [pytest.param(n, marks=SLOW) if n in LONG else n for n in SAID]


@pytest.mark.parametrize('name', NAMES)
def test_example_runs(name, tmp_path, monkeypatch, capsys):
    arguments = [str(tmp_path / 'out')]
    if name == 'batch':  # two bags are as good as all
        bags = tmp_path / 'bags'
        bags.mkdir()
        (bags / 'moving.mcap').symlink_to(REPO / 'bags' / 'moving.mcap')
        (bags / 'none.mcap').write_text('no bag')
        arguments.append(str(bags))
    monkeypatch.setenv('MPLBACKEND', 'Agg')
    monkeypatch.setattr(sys, 'argv', [name, *arguments])
    runpy.run_path(str(EXAMPLES / f'{name}.py'), run_name='__main__')
    assert SAID[name] in capsys.readouterr().out


def test_every_example_is_run():
    assert {path.stem for path in EXAMPLES.glob('*.py')} == set(SAID)
