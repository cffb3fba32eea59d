"""A bent board: displacements by errors of a tracker's model, found again, and the real runs."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from anser_ros.errors import FitError
from anser_ros.measured import anser_board
from anser_ros.measured.anser_response import EFFECTS, Points, response, stack
from anser_ros.sessions.starting_model import board_of
from anser_ros.wire.config_folder import read_config
from anser_ros.wire.setup import parse_setup

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path(os.environ.get('ANSER_SHARED', ROOT.parent / 'shared')) / 'measured' / 'anser_board'
needs_data = pytest.mark.skipif(not FOLDER.is_dir(), reason='no shared folder with measured data')


@pytest.fixture(scope='module')
def board():
    return board_of(parse_setup(read_config('demo_setup.yaml')))


@pytest.fixture(scope='module')
def where():
    grid = anser_board.grid()
    place = np.column_stack([anser_board.PITCH_M * grid, np.full(len(grid), 0.15)])
    return Points(place, grid / 2.0)


def solved(board, flux, start):
    """A full 5-DoF solve for an upright sensor's fluxes: its position."""
    scale = np.abs(flux).max()

    def misfit(x):
        tilt = np.array([x[3], x[4], np.sqrt(max(1.0 - x[3] ** 2 - x[4] ** 2, 0.0))])
        return (board.field((start + 1e-2 * x[:3])[None])[0] @ tilt - flux) / scale

    return start + 1e-2 * least_squares(misfit, np.zeros(5)).x[:3]


@pytest.mark.parametrize('coil', [0, 3])
def test_response_is_what_a_solver_would_answer(board, where, coil):
    answer = response(board, where.place_m)
    column = stack(EFFECTS['coil_gain'](board, where, answer))[:, :, coil]
    for k in (2, 12, 30):
        flux = answer.flux[k].copy()
        flux[coil] *= 1.001
        moved = solved(board, flux, where.place_m[k]) - where.place_m[k]
        np.testing.assert_allclose(moved, 0.1 * column[k], rtol=0.1, atol=2e-7)


def test_every_effect_has_finite_columns(board, where):
    answer = response(board, where.place_m)
    for name, make in EFFECTS.items():
        columns = stack(make(board, where, answer))
        assert columns.shape[:2] == (41, 3), name
        assert np.isfinite(columns).all(), name
        assert (np.abs(columns).max(axis=(0, 1)) > 1e-6).all(), f'{name} has a column of nothing'


def test_a_moved_board_coil_is_found_in_made_up_points(board, where):
    answer = response(board, where.place_m)
    rng = np.random.default_rng(0)
    truth = 2.0 * rng.normal(size=8)
    bent = where.place_m + stack(EFFECTS['coil_gain'](board, where, answer)) @ truth
    found = anser_board.study('made up', bent + 1e-4 * rng.normal(size=(41, 3)), board, {})
    assert found.search.end < 0.3 * found.search.start
    assert set(found.search.chosen) & {'coil_gain', 'coil_moved', 'coil_tilted'}
    assert anser_board.rms_m(found.nested_m) < 0.5 * anser_board.rms_m(found.rigid_m)
    assert found.field_share > 0.5


def test_a_scatter_of_single_points_is_not_explained(board, where):
    rng = np.random.default_rng(7)
    found = anser_board.study(
        'scatter', where.place_m + 2e-3 * rng.normal(size=(41, 3)), board, {}
    )
    assert anser_board.rms_m(found.fitted_m) > 0.85 * anser_board.rms_m(found.rigid_m)
    assert found.field_share < 0.5


def test_alignment_is_rigid():
    points = np.random.default_rng(1).normal(size=(41, 3))
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    np.testing.assert_allclose(
        anser_board.align(points, points @ turn.T + 0.3), points @ turn.T + 0.3, atol=1e-12
    )


def test_broken_lists_are_one_line(tmp_path):
    with pytest.raises(FitError, match='no runs'):
        anser_board.load(tmp_path)
    (tmp_path / 'few.fcsv').write_text('# head\nid,1,2,3\n')
    with pytest.raises(FitError, match='expected 41'):
        anser_board.load(tmp_path)
    (tmp_path / 'few.fcsv').write_text('id,1,x,3\n')
    with pytest.raises(FitError, match='few'):
        anser_board.load(tmp_path)


@needs_data
def test_real_runs_before_the_fit_are_as_known(board):
    reported = anser_board.load(FOLDER)
    grid = anser_board.grid()
    ideal = np.column_stack([anser_board.PITCH_M * grid, np.zeros(41)])
    size = {
        k: 1e3 * anser_board.rms_m(v - anser_board.align(ideal, v)) for k, v in reported.items()
    }
    assert size['standard_data_grid'] == pytest.approx(2.26, abs=0.01)
    assert size['steel_shield'] == pytest.approx(5.21, abs=0.01)
    part = anser_board.study('steel', reported['steel_shield'], board, {})
    assert part.field_share < 0.3
    analysis = anser_board.BoardAnalysis((part,), np.eye(1), {'scale': np.zeros(1)})
    assert len(anser_board.rows(analysis)) == 3
    assert 'correlation of neighbours' in anser_board.tables(analysis)
