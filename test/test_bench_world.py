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
    board, rng = world('boards').build(1, np.random.default_rng(7)), np.random.default_rng(8)
    lab = world('laboratory').Laboratory.clean(board)
    lab.on_optical.append(lambda t, p, r: (t - 0.03, p, r))
    exact = world('recording').record_session(tmp_path / 's02.mcap', lab, rng)
    bag = read_bag(tmp_path / 's02.mcap')
    assert bag.tool.flux.shape == (1000, len(board.tool.name), 9)
    assert bag.reference.flux.shape == (1000, len(board.reference.name), 9)
    optical = bag.optical[board.tool.body]
    stamps = optical.stamp_ns + 1e9 * 0.03
    seen = np.stack(
        [np.interp(exact['stamp_ns'], stamps, optical.position[:, i]) for i in range(3)], axis=1
    )
    inner = slice(5, -5)
    off = seen[inner] - exact['position'][inner]
    assert np.sqrt(np.mean(off**2)) == pytest.approx(0.07e-3, rel=0.25)
