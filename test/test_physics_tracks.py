"""Dipoles, current tracks, boards and the nominal model.

| what                              | must agree with                                            |
|-----------------------------------|------------------------------------------------------------|
| field of a dipole                 | magpylib; closed form on the axis and the equator          |
| gradient                          | central differences; symmetric; traceless                  |
| flux of a point sensor            | n . B                                                      |
| flux of a finite coil             | scalar potential difference; magpylib's line mean          |
| flux_jacobian                     | central differences, complex                               |
| coupling of two dipoles           | the same with both exchanged (reciprocity)                 |
| field turned with its source      | turned field                                               |
| segments                          | magpylib's polyline; the endless wire; the textbook's sign |
| closed paths                      | circle on its axis; dipole from far; no curl, no divergence|
| spirals                           | turns, sides and layers as drawn; moment of their area     |
| nominal model                     | the drawn board at points that took no part                |
| its modes                         | boards that are moved, tilted, scaled                      |
"""

import math

import magpylib
import numpy as np
import pytest
from metal_world import dipole_field, dipole_gradient
from tracking_world import GEOMETRY, anser_board

from anser_ros.errors import FitError, SetupError
from anser_ros.field.nominal import nominal_model
from anser_ros.physics import board as boards
from anser_ros.physics.board import Board, build_board, loop_field, segment_field, spiral_path
from anser_ros.physics.constants import DIPOLE_CONSTANT, MU_0
from anser_ros.physics.dipole import field_basis, flux_basis, flux_jacobian

SEED = 12


def loop_moment(corners, current_a=1.0):
    """Half of the current times all ``r x dr``, (3,), A m^2."""
    return 0.5 * current_a * np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)


def upward(board):
    """The moment along z of each of its coils, which are turned about z alone."""
    return loop_moment(board.shape, board.current_a)[2]


def one_coil(kind, geometry, rotation=0.0):
    return build_board(kind, geometry, ['coil0'], np.zeros((1, 3)), np.array([rotation]), [1e3])


def test_long_wire_is_the_endless_one():
    """B = mu0 I / (2 pi r) times the sine of the angle that its half is seen under.

    A current along +z turns the field counter-clockwise: at +x it points to +y.
    """
    half, away = 2.0, 0.02
    field = segment_field(
        np.array([[0, 0, -half]]), np.array([[0, 0, half]]), np.array([[away, 0, 0]]), 3.0
    )
    endless = MU_0 * 3.0 / (2 * math.pi * away)
    assert field[0, 1] == pytest.approx(endless * half / math.hypot(half, away), rel=1e-9)
    assert field[0, 0] == field[0, 2] == 0


def test_segments_are_magpylibs(rng):
    corners = rng.normal(size=(9, 3))
    points = rng.normal(size=(20, 3)) + [0, 0, 4.0]
    source = magpylib.current.Polyline(current=2.5, vertices=np.vstack([corners, corners[:1]]))
    np.testing.assert_allclose(loop_field(corners, points, 2.5), source.getB(points), rtol=1e-7)


def test_points_in_line_with_a_segment_and_segments_without_length_have_no_field():
    start, end = np.zeros((1, 3)), np.array([[0, 0, 1.0]])
    points = np.array([[0, 0, 1.5], [1e-9, 0, 2.0]])
    assert np.abs(segment_field(start, end, points)).max() < 1e-12
    assert (segment_field(start, start, points) == 0).all()


def test_circle_on_its_axis():
    """B_z = mu0 I R^2 / (2 (R^2 + z^2)^(3/2))."""
    board = one_coil('circular_loop', {'radius_m': 0.05, 'turns': 3, 'current_a': 0.2})
    z = np.array([0.05, 0.1, 0.2])
    field = board.field(np.stack([0 * z, 0 * z, z], axis=1))[:, 0]
    expected = MU_0 * 0.6 * 0.05**2 / (2 * (0.05**2 + z**2) ** 1.5)
    np.testing.assert_allclose(field[:, 2], expected, rtol=2e-3)
    assert np.abs(field[:, :2]).max() < 1e-12
    assert upward(board) == pytest.approx(0.6 * math.pi * 0.05**2, rel=1e-12)


def test_a_loop_from_far_is_a_dipole(rng):
    corners = rng.normal(size=(6, 3)) * 0.01
    moment = loop_moment(corners, 1.5)
    points = rng.normal(size=(8, 3))
    points *= 20.0 / np.linalg.norm(points, axis=1)[:, None]
    centre = np.zeros((1, 3))
    np.testing.assert_allclose(
        loop_field(corners, points, 1.5), dipole_field(points, centre, moment[None]), rtol=0.02,
        atol=0.02 * 1e-7 * np.linalg.norm(moment) / 20.0**3,
    )  # fmt: skip


def test_closed_paths_have_neither_curl_nor_divergence():
    board = anser_board()
    points = np.random.default_rng(3).uniform([-0.1, -0.1, 0.06], [0.1, 0.1, 0.2], (6, 3))
    gradient = np.stack(
        [
            (board.field(points + step) - board.field(points - step)) / 2e-5
            for step in 1e-5 * np.eye(3)
        ],
        axis=2,
    )
    size = np.abs(gradient).max()
    assert np.abs(np.trace(gradient, axis1=2, axis2=3)).max() < 1e-6 * size
    assert np.abs(gradient - gradient.swapaxes(2, 3)).max() < 1e-6 * size


def test_the_anser_spiral_as_public_sources_describe_it():
    """25 turns on two layers, about 101 tracks; a cheap model is 25.15 loops of 61.5 mm."""
    path = spiral_path(0.07, 0.07, 0.00075, 25, 2, 0.0016)
    tracks = np.roll(path, -1, axis=0) - path
    assert 100 <= len(path) <= 104
    assert (np.count_nonzero(np.abs(tracks) > 1e-12, axis=1) == 1).all(), 'all along x, y or z'
    assert np.ptp(path[:, 0]) == pytest.approx(0.07)
    assert set(np.round(path[:, 2], 9)) == {0.0, -0.0016}
    assert loop_moment(path)[2] == pytest.approx(25.15 * 0.0615**2, rel=5e-3)
    sides = np.abs(tracks[np.abs(tracks[:, 1]) > 0.02][:, 1])
    assert np.diff(np.sort(sides)).max() <= 0.00076


def test_spirals_wind_clockwise_unless_told_otherwise():
    clockwise = one_coil('square_spiral_pcb', GEOMETRY)
    other = one_coil('square_spiral_pcb', {**GEOMETRY, 'winding': 'ccw'})
    assert upward(clockwise) < 0 < upward(other)
    points = np.array([[0.01, 0.02, 0.1]])
    np.testing.assert_allclose(clockwise.field(points), -other.field(points), rtol=1e-9)


@pytest.mark.parametrize('layers', [1, 2, 3, 6])
def test_any_number_of_layers_gives_the_same_moment(layers):
    geometry = {'side_m': 0.1, 'pitch_m': 0.0004, 'turns': 48, 'layers': layers,
                'thickness_m': 0.001}  # fmt: skip
    path = one_coil('square_spiral_pcb', {**geometry, 'winding': 'ccw'}).shape
    per_layer = 48 / layers
    sides = 0.1 - 2 * 0.0004 * (np.arange(math.ceil(per_layer)))
    assert loop_moment(path)[2] == pytest.approx(layers * np.sum(sides**2), rel=5e-3)


def test_rectangles_and_turning():
    geometry = {'side_x_m': 0.1, 'side_y_m': 0.04, 'turns': 5, 'current_a': 2.0}
    board = one_coil('rectangular_loop', geometry, 90.0)
    assert upward(board) == pytest.approx(5 * 2.0 * 0.1 * 0.04)
    assert np.ptp(board.paths[0][:, 1]) == pytest.approx(0.1), 'turned by 90 degrees'
    spiral = one_coil('rectangular_spiral_pcb', {**geometry, 'pitch_m': 0.001, 'winding': 'ccw'})
    assert 0.6 < upward(spiral) / upward(board) < 1.0


@pytest.mark.parametrize(
    ('change', 'word'),
    [
        ({'turns': None}, 'turns must be a number'),
        ({'turns': 'many'}, 'turns must be a number'),
        ({'turns': 1e9}, 'more than'),
        ({'turns': 400}, 'do not fit'),
        ({'side_m': -1.0}, 'side_m must be finite'),
        ({'pitch_m': math.nan}, 'pitch_m must be finite'),
        ({'layers': 1.5}, 'layers must be a whole number'),
        ({'layers': 0}, 'layers must be finite and above 1'),
        ({'winding': 'left'}, 'winding must be'),
        ({'current_a': True}, 'current_a must be a number'),
    ],
)
def test_geometry_that_can_not_be_drawn_is_refused(change, word):
    with pytest.raises(SetupError, match=word):
        one_coil('square_spiral_pcb', {**GEOMETRY, **change})


def test_other_refusals():
    with pytest.raises(SetupError, match='is none of'):
        one_coil('helmholtz', {})
    with pytest.raises(SetupError, match='sides must be'):
        one_coil('circular_loop', {'radius_m': 0.1, 'sides': 2})
    with pytest.raises(SetupError, match='do not match'):
        build_board('circular_loop', {'radius_m': 0.1}, ['a', 'b'], np.zeros((1, 3)),
                    np.zeros(1), [1.0])  # fmt: skip
    with pytest.raises(ValueError, match='must have shape'):
        segment_field(np.zeros(3), np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(ValueError, match='must match'):
        segment_field(np.zeros((2, 3)), np.zeros((1, 3)), np.zeros((1, 3)))
    board = one_coil('rectangular_loop', {'side_x_m': 3.0, 'side_y_m': 3.0})
    with pytest.raises(FitError, match='miss the nominal field'):
        nominal_model(board)


def test_every_kind_has_a_nominal_model():
    geometry = {'side_m': 0.098, 'side_x_m': 0.12, 'side_y_m': 0.06, 'radius_m': 0.05,
                'turns': 40, 'pitch_m': 0.0004, 'layers': 2, 'thickness_m': 0.0016,
                'current_a': 0.5}  # fmt: skip
    for kind in boards.KINDS:
        centres = np.array([[-0.1, 0, 0], [0.1, 0, 0], [0, 0.1, 0.01]])
        board = build_board(kind, geometry, ['a', 'b', 'c'], centres, np.zeros(3), [1, 2, 3])
        model = nominal_model(board)
        assert model.emitters == ('a', 'b', 'c')
        assert model.provenance['heldout_relative_rms'] < 1e-3, kind


def test_nominal_model_is_the_drawn_board():
    """Target: 2e-4 of the field from 6 cm on, at points that took no part."""
    board = anser_board()
    model = nominal_model(board)
    rng = np.random.default_rng(9)
    points = rng.uniform([-0.15, -0.15, 0.06], [0.15, 0.15, 0.3], (400, 3))
    truth = board.field(points)
    field = np.stack(
        [model.flux(points, np.broadcast_to(a, points.shape)).real for a in np.eye(3)], axis=2
    )
    relative = np.linalg.norm(field - truth, axis=2) / np.linalg.norm(truth, axis=2)
    assert len(model.positions) == 144
    assert np.sqrt(np.mean(relative**2)) < 2e-4
    assert relative.max() < 3e-3
    assert model.provenance['heldout_relative_rms'] < 2e-4


@pytest.mark.parametrize(
    ('row', 'shift', 'tilt', 'gain'),
    [
        (0, (0, 0, 0), (0, 0, 0), 0.02),
        (1, (5e-4, 0, 0), (0, 0, 0), 0.0),
        (3, (0, 0, 5e-4), (0, 0, 0), 0.0),
        (5, (0, 0, 0), (0, 5e-3, 0), 0.0),
    ],
)
def test_modes_are_boards_that_are_off_by_a_tolerance(row, shift, tilt, gain):
    whole = anser_board()
    board = Board(
        whole.names[:1], whole.frequencies_hz[:1], whole.shape, whole.current_a,
        np.zeros((1, 3)), np.eye(3)[None],
    )  # fmt: skip
    model = nominal_model(board)
    points = np.random.default_rng(1).uniform([-0.1, -0.1, 0.1], [0.1, 0.1, 0.2], (50, 3))
    moved = whole.shape + np.array(shift) + np.cross(np.array(tilt), whole.shape)
    change = (1 + gain) * loop_field(moved, points, whole.current_a)
    change = change - board.field(points)[:, 0]
    axes = np.eye(3)
    mode = type(model)(
        model.positions, model.directions, model.modes[row], model.emitters,
        model.frequencies_hz,
    )  # fmt: skip
    field = np.stack(
        [mode.flux(points, np.broadcast_to(a, points.shape))[:, 0].real for a in axes], axis=1
    )
    # A layer at one height can only nearly stand for a shift in height: it is a tolerance.
    assert np.linalg.norm(field - change) < 0.15 * np.linalg.norm(change)


@pytest.fixture
def world(rng):
    """Points above a layer of dipoles of any direction."""
    positions = rng.uniform(-0.1, 0.1, (7, 3)) * [1, 1, 0.1]
    directions = rng.normal(size=(7, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = rng.uniform(-0.1, 0.1, (5, 3)) + [0, 0, 0.2]
    axes = rng.normal(size=(5, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    return points, axes, positions, directions


def test_field_on_axis_and_equator():
    """Jackson, Classical Electrodynamics, section 5.6."""
    points = np.array([[0, 0, 0.1], [0.1, 0, 0]])
    field = dipole_field(points, np.zeros((1, 3)), np.array([[0, 0, 2.0]]))
    np.testing.assert_allclose(field, [[0, 0, 2 * 2e-7 / 1e-3], [0, 0, -2e-7 / 1e-3]], atol=1e-18)


def test_field_is_magpylibs(world, rng):
    points, _, positions, _ = world
    moments = rng.normal(size=(7, 3))
    sources = [
        magpylib.misc.Dipole(position=p, moment=m) for p, m in zip(positions, moments, strict=True)
    ]
    expected = magpylib.getB(sources, points, sumup=True)
    np.testing.assert_allclose(dipole_field(points, positions, moments), expected, rtol=1e-9)


def test_basis_is_flux_along_each_axis(world):
    points, axes, positions, directions = world
    basis = field_basis(points, positions, directions)
    flux = flux_basis(points, axes, None, positions, directions)
    np.testing.assert_allclose(flux, np.einsum('pni,pi->pn', basis, axes), rtol=1e-12)


def test_gradient_is_that_of_the_field_symmetric_and_traceless(world, rng):
    points, _, positions, _ = world
    moments = rng.normal(size=(7, 3))
    gradient = dipole_gradient(points, positions, moments)
    for i, step in enumerate(1e-6 * np.eye(3)):
        above = dipole_field(points + step, positions, moments)
        below = dipole_field(points - step, positions, moments)
        np.testing.assert_allclose(
            gradient[:, i], (above - below) / 2e-6, rtol=1e-6, atol=1e-6 * np.abs(gradient).max()
        )
    np.testing.assert_allclose(gradient, gradient.swapaxes(1, 2))
    trace = np.trace(gradient, axis1=1, axis2=2)
    assert np.abs(trace).max() < 1e-12 * np.abs(gradient).max(), 'div B = 0'


def test_reciprocity(rng):
    first, second = rng.normal(size=(2, 1, 3))
    u, v = rng.normal(size=(2, 1, 3))
    there = flux_basis(second, v, None, first, u)
    back = flux_basis(first, u, None, second, v)
    np.testing.assert_allclose(there, back, rtol=1e-12)


def test_turning_everything_turns_the_field(world, rng):
    points, _, positions, _ = world
    moments = rng.normal(size=(7, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    turned = dipole_field(points @ turn.T, positions @ turn.T, moments @ turn.T)
    np.testing.assert_allclose(turned, dipole_field(points, positions, moments) @ turn.T)


def potential(point, positions, directions):
    """Magnetic scalar potential (T m) of unit dipoles, so that B = -grad."""
    d = point - positions
    return DIPOLE_CONSTANT * np.sum(d * directions, axis=1) / np.linalg.norm(d, axis=1) ** 3


@pytest.mark.parametrize('length', [0.004, 0.008, 0.016])
def test_finite_coil_is_the_potential_difference_over_its_length(world, length):
    """Cavaliere and Cantillon-Murphy 2022; two Gauss points are off by order L^4."""
    points, axes, positions, directions = world
    flux = flux_basis(points, axes, np.full(5, length), positions, directions)
    for p in range(5):
        ends = [points[p] + s * 0.5 * length * axes[p] for s in (1, -1)]
        high, low = (potential(end, positions, directions) for end in ends)
        mean = -(high - low) / length
        size = np.abs(mean).max()
        nearest = np.linalg.norm(points[p] - positions, axis=1).min()
        np.testing.assert_allclose(flux[p], mean, atol=5.0 * (length / nearest) ** 4 * size)


@pytest.mark.parametrize('length', [0.0, 0.01])
def test_jacobian_is_that_of_the_flux(world, rng, length):
    points, axes, positions, directions = world
    moments = rng.normal(size=(7, 4)) + 1j * rng.normal(size=(7, 4))
    lengths = np.full(5, length)

    def flux(at, along):
        return flux_basis(at, along, lengths, positions, directions) @ moments

    value, by_place, by_axis = flux_jacobian(points, axes, lengths, positions, directions, moments)
    np.testing.assert_allclose(value, flux(points, axes), rtol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(3)):
        slope = (flux(points + step, axes) - flux(points - step, axes)) / 2e-6
        np.testing.assert_allclose(by_place[:, i], slope, atol=1e-7 * np.abs(by_place).max())
        slope = (flux(points, axes + step) - flux(points, axes - step)) / 2e-6
        np.testing.assert_allclose(by_axis[:, i], slope, atol=1e-7 * np.abs(by_axis).max())


def test_shapes_that_do_not_fit_are_refused(world):
    points, axes, positions, directions = world
    with pytest.raises(ValueError, match='must have shape'):
        flux_basis(points[0], axes, None, positions, directions)
    with pytest.raises(ValueError, match='must match'):
        flux_basis(points, axes[:2], None, positions, directions)
