"""A tracker's points over a flat board: what they show of a map, and that noise shows none."""

import numpy as np
import pytest
from conftest import SHARED, needs
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.measured import anser_board
from anser_ros.calibration.error_map import LEAST_GAIN_SIGMAS, learn_error_map
from anser_ros.cli.main import main
from anser_ros.errors import BagError, FitError

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
