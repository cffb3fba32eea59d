"""The field world of the benchmarks: right by closed forms, and with a physics of its own."""

import ast
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from anser_ros.wire.bag import read_bag

WORLD = Path(__file__).parent / 'bench' / 'world'


@pytest.fixture(scope='module')
def world():
    """Load a module of the world by its name; the modules import each other as a script's do."""
    sys.path.insert(0, str(WORLD))
    yield importlib.import_module
    sys.path.remove(str(WORLD))


def test_only_the_writer_of_bags_is_shared():
    for path in WORLD.glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ''] if isinstance(node, ast.ImportFrom) else []
            ours = {n for n in names if n.split('.')[0] == 'anser_ros'}
            assert ours <= {'anser_ros.wire.bag_writer', 'anser_ros.wire.points'}, path.name


def test_a_coil_has_the_field_that_magpylib_gives_it(world):
    magpylib = pytest.importorskip('magpylib')
    rng = np.random.default_rng(3)
    board = world('boards').build(3, rng)
    points = rng.uniform(-0.1, 0.1, (20, 3)) + [0.0, 0.0, 0.16]
    field = board.field(points)
    for k, path in enumerate(board.paths):
        track = np.concatenate([path, path[:1]])
        track = track[np.append(True, np.linalg.norm(np.diff(track, axis=0), axis=1) > 1e-9)]
        theirs = magpylib.current.Polyline(current=board.amperes[k], vertices=track).getB(points)
        np.testing.assert_allclose(field[:, k], theirs, atol=1e-8 * np.abs(theirs).max())


def test_a_coil_has_the_turns_and_the_way_of_its_drawing(world):
    for index, sign in ((0, -1.0), (2, 1.0)):  # clockwise, counter-clockwise
        board = world('boards').build(index, np.random.default_rng(4))
        winding = board.design.winding
        inner = winding.side_x_m - 2 * winding.pitch_m * winding.turns / 2
        mean_square = (winding.side_x_m**2 + winding.side_x_m * inner + inner**2) / 3
        for path in board.paths:
            closed = np.cross(path, np.roll(path, -1, axis=0)).sum(axis=0) / 2
            assert closed[2] == pytest.approx(sign * winding.turns * mean_square, rel=0.04)


def test_a_sphere_is_the_textbooks_at_both_ends(world):
    polarizability = world('spheres').polarizability
    unit = 4 * np.pi * 0.02**3 / world('filaments').MU_0
    omega = 2 * np.pi * 6500
    assert polarizability(0.02, 1e13, 1.0, omega) == pytest.approx(-unit / 2, rel=1e-3)
    at_rest = polarizability(0.02, 1e-3, 50.0, omega)
    assert at_rest == pytest.approx(unit * 49 / 52, rel=1e-4)


def test_no_body_gives_energy(world):
    rng = np.random.default_rng(5)
    bodies, response = world('bodies'), world('spheres').response
    for body in (
        bodies.head(rng),
        bodies.block(rng, 0.04, 'steel'),
        bodies.rail(rng, 'brass', 0.3),
    ):
        matrix = response(body, [2 * np.pi * 6500])[0]
        np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-9 * np.abs(matrix).max())
        absorbed = (matrix - matrix.conj().T) / 2j
        assert np.linalg.eigvalsh(absorbed).max() < 0


@pytest.mark.long
def test_a_large_sheet_of_a_good_conductor_is_a_mirror(world):
    sheets, omega = world('sheets'), np.array([2 * np.pi * 6500])
    sheet = sheets.Sheet(np.array([0.0, 0.0, -0.05]), np.eye(3), 1.0, 1e-9, cells=26)
    grid = sheets.mesh(sheet)
    dipole = world('spheres').dipole_field
    moment = np.array([[[0.3 + 0j], [0.0], [1.0]]])
    nodes = sheets.flux_nodes(grid, sheet)
    drive = dipole(nodes.reshape(-1, 3), np.array([[0.0, 0.0, 0.1]]), moment)[:, 0, 2]
    currents = sheets.edge_currents(grid, drive.reshape(-1, 4).mean(axis=1)[:, None], omega)
    points = np.array([[0.03, 0.0, 0.05], [0.0, 0.1, 0.02], [-0.05, -0.03, 0.15]])
    answer = sheets.sheet_field(points, grid, currents)[:, 0]
    mirrored = moment * np.array([1.0, 1.0, -1.0])[None, :, None]
    image = dipole(points, np.array([[0.0, 0.0, -0.2]]), mirrored)[:, 0]
    np.testing.assert_allclose(answer, image, atol=0.05 * np.abs(image).max())


def test_two_scatterers_answer_to_each_other(world):
    laboratory, boards = world('laboratory'), world('boards')
    spheres, motions = world('spheres'), world('motions')
    board = boards.build(0, np.random.default_rng(6))
    place = np.array([[0.0, 0.0, 0.0], [0.025, 0.0, 0.0]])
    material = (np.full(2, 0.01), np.full(2, 5e6), np.full(2, 100.0))
    both = spheres.Body(place, *material)
    at = motions.resting([0.02, 0.01, -0.08], [0.0, 0.0, 0.4])
    points = np.array([[[0.0, 0.0, 0.1], [0.05, -0.02, -0.03]]])
    fields = []
    for metals in (
        [(both, at)],
        [(spheres.Body(place[i : i + 1], *(v[:1] for v in material)), at) for i in range(2)],
    ):
        lab = laboratory.Laboratory.clean(board)
        lab.metals = metals
        fields.append(laboratory.Scattered(lab, np.zeros(1)).field(points))
    np.testing.assert_allclose(*fields, atol=1e-3 * np.abs(fields[0]).max())


@pytest.mark.long
def test_a_session_reads_as_the_interfaces_say(world, tmp_path):
    make, boards = world('make'), world('boards')
    board = boards.build(1, np.random.default_rng(7))
    (tmp_path / 'truth').mkdir()
    truth = make.make_session(tmp_path, board, 's02', ('time_offset', 'sensor_gain'), 8)
    assert set(truth) == {'time_offset', 'sensor_gain'}
    bag = read_bag(tmp_path / 's02.mcap')
    assert bag.tool.flux.shape == (1000, len(board.tool.name), 9)
    assert bag.reference.flux.shape == (1000, len(board.reference.name), 9)
    optical = bag.optical[board.tool.body]
    exact = np.load(tmp_path / 'truth' / 's02.npz')
    stamps = optical.stamp_ns + 1e9 * truth['time_offset']['offset_s']
    seen = np.stack(
        [np.interp(exact['stamp_ns'], stamps, optical.position[:, i]) for i in range(3)], axis=1
    )
    inner = slice(5, -5)
    off = seen[inner] - exact['position'][inner]
    assert np.sqrt(np.mean(off**2)) == pytest.approx(0.07e-3, rel=0.25)
