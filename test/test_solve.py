"""One coil's solve, warm and cold: exact poses, derivatives, and its own claim of accuracy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracking_world import NOISE_T, certain_model

from anser_ros.errors import TrackingError
from anser_ros.field.nominal import nominal_model
from anser_ros.physics import rotations
from anser_ros.physics.board import build_board
from anser_ros.physics.rotations import (
    axis_angles,
    fill_tangent,
    nearest_rotation,
    rotation_angles,
)
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.seed import build_grid, grid_points, solve_cold
from anser_ros.tracking.solve import (
    UNKNOWN_VARIANCE,
    RealField,
    bounded_inverse,
    chi2_limit,
    coil_covariance,
    solve_coil,
    whitening_of,
)

SEED = 21
MODEL = certain_model()
FIELD = RealField.of(MODEL.positions, MODEL.directions, MODEL.moments)
LOW, HIGH = TrackedVolume().grown(0.03)
WIDTH = FIELD.moments.shape[1]
WHITENING = whitening_of(np.full(WIDTH, NOISE_T))


def pose(rng, low=0.08, high=0.25):
    axis = rng.normal(size=3)
    return rng.uniform([-0.12, -0.12, low], [0.12, 0.12, high]), axis / np.linalg.norm(axis)


def flux_of(position, axis, length=0.0):
    flux = MODEL.flux(position[None], axis[None], np.array([length]))
    return np.ascontiguousarray(flux).view(np.float64)[0]


def nearby(rng, position, axis, move=2e-3, turn=0.035):
    step = rng.normal(size=3)
    other = axis + turn * np.cross(axis, rng.normal(size=3))
    return position + move * step / np.linalg.norm(step), other / np.linalg.norm(other)


@pytest.mark.parametrize('length', [0.0, 0.008])
@pytest.mark.parametrize(('move', 'turn'), [(2e-3, 0.035), (0.02, 0.3)])
def test_exact_fluxes_give_the_exact_pose(rng, length, move, turn):
    for _ in range(50):
        position, axis = pose(rng)
        start, first = nearby(rng, position, axis, move, turn)
        found = solve_coil(
            FIELD, flux_of(position, axis, length), WHITENING, start, first, LOW, HIGH, length
        )
        assert found.converged
        assert found.chi2 < 1e-3
        assert np.linalg.norm(found.position - position) < 1e-6
        assert np.linalg.norm(found.axis - axis) < 1e-5
        assert np.linalg.norm(found.axis) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize('axis', [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0)])
def test_no_axis_is_singular(rng, axis):
    """Along z is where people calibrate, and where theta and phi fail."""
    axis = np.array(axis, dtype=float)
    position = np.array([0.02, -0.03, 0.15])
    start, first = nearby(rng, position, axis)
    found = solve_coil(FIELD, flux_of(position, axis), WHITENING, start, first, LOW, HIGH)
    assert np.linalg.norm(found.position - position) < 1e-6
    assert np.isfinite(coil_covariance(found.normal, found.axis, 3.3)).all()


def test_warm_solve_needs_few_evaluations(rng):
    used = []
    for _ in range(100):
        position, axis = pose(rng)
        flux = flux_of(position, axis) + NOISE_T * rng.normal(size=WIDTH)
        start, first = nearby(rng, position, axis)
        used.append(solve_coil(FIELD, flux, WHITENING, start, first, LOW, HIGH).evaluations)
    assert np.median(used) <= 5
    assert max(used) <= 10


def test_covariance_and_chi_square_are_what_happens(rng):
    """500 noisy solves: errors in units of their covariance have unit variance."""
    errors, chi2 = [], []
    for _ in range(500):
        position, axis = pose(rng)
        flux = flux_of(position, axis) + NOISE_T * rng.normal(size=WIDTH)
        found = solve_coil(FIELD, flux, WHITENING, position, axis, LOW, HIGH)
        covariance = coil_covariance(found.normal, found.axis, 3.3)
        turn = np.cross(axis, found.axis)
        error = np.concatenate([found.position - position, turn])
        # The roll is unknown; leave its direction out.
        values, vectors = np.linalg.eigh(covariance)
        part = vectors[:, :5].T @ error / np.sqrt(values[:5])
        errors.append(part @ part)
        chi2.append(found.chi2)
    assert np.mean(errors) == pytest.approx(5.0, rel=0.1)
    assert np.mean(chi2) == pytest.approx(WIDTH - 5, rel=0.1)


def test_common_errors_count_less_when_the_model_is_uncertain(rng):
    """With modes in the whitening, errors along them are expected, and the pose is less sure."""
    position, axis = pose(rng)
    flux = flux_of(position, axis)
    modes = 0.01 * np.diag(np.abs(flux))[::2]
    covariance = np.eye(WIDTH) * NOISE_T**2 + modes.T @ modes
    weights = np.linalg.inv(np.linalg.cholesky(covariance))
    found = solve_coil(FIELD, flux + modes[2], weights, position, axis, LOW, HIGH)
    assert found.chi2 < 2.0
    plain = solve_coil(FIELD, flux + modes[2], WHITENING, position, axis, LOW, HIGH)
    assert plain.chi2 > 100.0
    sure = np.trace(coil_covariance(plain.normal, plain.axis, 1.0)[:3, :3])
    assert np.trace(coil_covariance(found.normal, found.axis, 1.0)[:3, :3]) > 10 * sure


def test_the_solver_never_leaves_its_box(rng):
    position, axis = np.array([0.05, 0.02, 0.09]), np.array([0.0, 0.0, 1.0])
    mirrored = position * [1, 1, -1]
    low, high = np.array([-0.3, -0.3, 0.02]), np.array([0.3, 0.3, 0.5])
    found = solve_coil(FIELD, flux_of(mirrored, axis), WHITENING, position, axis, low, high)
    assert (found.position >= low).all()
    assert (found.position <= high).all()


def test_tangents_complete_a_right_handed_frame(rng):
    for axis in [*rng.normal(size=(50, 3)), [0, 0, 1], [0, 0, -1], [1e-12, 0, -1]]:
        n = np.array(axis, dtype=float)
        n /= np.linalg.norm(n)
        t = np.empty((2, 3))
        fill_tangent(n, t)
        frame = np.stack([t[0], t[1], n])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(frame) == pytest.approx(1.0)


@pytest.mark.parametrize('weakest', [1.0, 1e-6, 1e-11, 0.0])
def test_covariances_are_inverses_however_weak_a_direction_is(rng, weakest):
    """By factor or by eigenvectors: a weak direction leaves the others as they are."""
    for _ in range(20):
        turn = np.linalg.qr(rng.normal(size=(5, 5)))[0]
        # Values of 1 m^2 and below, which no bound changes.
        values = np.array([1.0, 2.0, 5.0, 20.0, max(weakest, 1e-30)]) * 1e12
        information = (turn * values) @ turn.T
        covariance = bounded_inverse(0.5 * (information + information.T))
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
        assert (np.diag(covariance) <= UNKNOWN_VARIANCE * (1 + 1e-9)).all()
        along = turn.T @ covariance @ turn
        if weakest >= 1e-6:
            np.testing.assert_allclose(along, np.diag(1.0 / values), atol=2e-5 / values.min())
        else:
            assert along[4, 4] > 1e3 / values[0]


def test_a_coil_s_covariance_turns_about_its_axis_by_the_roll_alone(rng):
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    root = rng.normal(size=(40, 6)) * [1e5, 1e5, 1e5, 1e3, 1e3, 1e3]
    covariance = coil_covariance(root.T @ root, axis, 0.7)
    assert axis @ covariance[3:, 3:] @ axis == pytest.approx(0.7)
    np.testing.assert_allclose(covariance[:3, 3:] @ axis, 0.0, atol=1e-12)
    # A turn w moves the axis by w x n: of the free axis' covariance what is along it is not seen.
    t = np.linalg.svd(axis[None])[2][1:]
    back = np.zeros((6, 5))
    back[:3, :3], back[3:, 3:] = np.eye(3), t.T
    inner = np.linalg.inv(back.T @ (root.T @ root) @ back)
    np.testing.assert_allclose(covariance[:3, :3], inner[:3, :3], rtol=1e-9)
    moves = back @ inner @ back.T
    cross = np.cross(np.eye(3), axis)  # row i: the i-th unit vector times the axis
    np.testing.assert_allclose(cross.T @ covariance[3:, 3:] @ cross, moves[3:, 3:], atol=1e-15)


def test_refusals():
    good = (MODEL.positions, MODEL.directions, MODEL.moments)
    with pytest.raises(TrackingError, match='must be finite'):
        RealField.of(good[0] * np.nan, good[1], good[2])
    for sigma in (0.0, -1.0, np.nan):
        with pytest.raises(TrackingError, match='positive and finite'):
            whitening_of(np.full(WIDTH, sigma))
    with pytest.raises(TrackingError, match='flux components'):
        solve_coil(FIELD, np.zeros(4), WHITENING, LOW, LOW, LOW, HIGH)


def test_roll_rule_takes_z_to_the_axis_the_shortest_way(rng):
    for _ in range(50):
        _, axis = pose(rng)
        matrix = rotations.rotation_of_quaternion(np.array(rotations.quaternion_of_axis(axis)))
        np.testing.assert_allclose(matrix[:, 2], axis, atol=1e-12)
        turn = Rotation.from_matrix(matrix).as_rotvec()
        assert abs(turn[2]) < 1e-12, 'no roll'
        assert np.linalg.norm(turn) == pytest.approx(np.arccos(axis[2]), abs=1e-9)
    assert rotations.quaternion_of_axis(np.array([0.0, 0, -1])) == (1.0, 0.0, 0.0, 0.0)
    assert rotations.quaternion_of_axis(np.array([0.0, 0, 1])) == (0.0, 0.0, 0.0, 1.0)


def test_rotation_conversions_agree(rng):
    for scale in (1e-9, 1e-3, 1.0, 3.1):
        vector = rng.normal(size=3)
        vector *= scale / np.linalg.norm(vector)
        matrix = rotations.rotation_of_vector(vector)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(Rotation.from_matrix(matrix).as_rotvec(), vector, atol=1e-9)
        q = rotations.quaternion_of_rotation(matrix)
        assert q[3] >= 0
        np.testing.assert_allclose(
            rotations.rotation_of_quaternion(np.array(q)), matrix, atol=1e-12
        )


@pytest.mark.parametrize('i', [0, 1, 2])
def test_half_turns(i):
    matrix = -np.eye(3)
    matrix[i, i] = 1.0
    q = rotations.quaternion_of_rotation(matrix)
    np.testing.assert_allclose(rotations.rotation_of_quaternion(np.array(q)), matrix, atol=1e-12)


def test_nearest_rotation_is_proper(rng):
    mirror = np.diag([1.0, 1.0, -1.0]) + 0.01 * rng.normal(size=(3, 3))
    assert np.linalg.det(nearest_rotation(mirror)) == pytest.approx(1.0)


ANGLES = np.array([0.0, 1e-12, 1e-6, 0.3, 1.5, np.pi - 1e-6, np.pi])


@pytest.fixture
def turns():
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(ANGLES.size, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True) * ANGLES[:, None]


def test_angles_of_rotations_and_between_axes_are_those_which_made_them(turns):
    matrices = Rotation.from_rotvec(turns).as_matrix()
    np.testing.assert_allclose(rotation_angles(matrices), ANGLES, rtol=1e-9, atol=1e-15)
    assert rotation_angles(matrices[3]) == pytest.approx(0.3, rel=1e-12)
    assert np.isnan(rotation_angles(np.full((3, 3), np.nan)))
    rng = np.random.default_rng(2)
    first = np.cross(np.where(ANGLES[:, None] > 0, turns, 1.0), rng.normal(size=turns.shape))
    second = 3.0 * Rotation.from_rotvec(turns).apply(first)
    # Turned axes are rounded to 1e-16 of their length, and so are angles.
    np.testing.assert_allclose(axis_angles(first, second), ANGLES, rtol=1e-9, atol=1e-15)
    assert np.isnan(axis_angles(first[0], np.full(3, np.nan)))


SIGMA = np.full(WIDTH, NOISE_T)
VOLUME = TrackedVolume()
GATE = chi2_limit(WIDTH - 5, 1e-9)
GRID = build_grid(FIELD, SIGMA, VOLUME, 0.035)


def poses(rng, count):
    axes = rng.normal(size=(count, 3))
    points = rng.uniform([-0.125, -0.125, 0.08], [0.125, 0.125, 0.25], (count, 3))
    return points, axes / np.linalg.norm(axes, axis=1)[:, None]


def fluxes(points, axes, rng=None, lengths=None, model=MODEL):
    flux = np.ascontiguousarray(model.flux(points, axes, lengths)).view(np.float64)
    return flux if rng is None else flux + NOISE_T * rng.normal(size=flux.shape)


@pytest.mark.parametrize('length', [0.0, 0.008])
def test_every_pose_is_found_without_a_guess(rng, length):
    """Any axis, 25 x 25 cm, z 8 to 25 cm, noise 60 pT: all within 2 mm (10,000 in the bench)."""
    points, axes = poses(rng, 600)
    measured = fluxes(points, axes, rng, np.full(600, length))
    for flux, point, axis in zip(measured, points, axes, strict=True):
        best, *rivals = solve_cold(FIELD, GRID, flux, WHITENING, LOW, HIGH, length, GATE)
        assert np.linalg.norm(best.position - point) < 2e-3
        assert np.linalg.norm(best.axis - axis) < 0.05
        assert best.chi2 < GATE
        assert all(rival.chi2 > GATE for rival in rivals), 'eight coils tell all poses apart'


def test_the_length_of_the_axis_tells_places_apart(rng):
    """Half the flux is another place, not a shorter axis."""
    points, axes = poses(rng, 1)
    flux = fluxes(points, axes)[0]
    best = solve_cold(FIELD, GRID, 0.5 * flux, WHITENING, LOW, HIGH, 0.0, GATE)[0]
    assert np.linalg.norm(best.position - points[0]) > 5e-3
    assert best.chi2 > GATE


def test_three_emitters_leave_one_coil_ambiguous(rng):
    """Three fluxes can't tell five unknowns: several distinct poses explain them."""
    board = build_board(
        'circular_loop', {'radius_m': 0.05, 'turns': 50}, ['a', 'b', 'c'],
        np.array([[-0.1, 0, 0], [0.1, 0, 0], [0, 0.12, 0]]), np.zeros(3), [1e3, 2e3, 3e3],
    )  # fmt: skip
    model = nominal_model(board)
    field = RealField.of(model.positions, model.directions, model.moments)
    grid = build_grid(field, np.full(6, NOISE_T), VOLUME, 0.035)
    points, axes = poses(rng, 1)
    flux = fluxes(points, axes, model=model)[0]
    found = solve_cold(
        field, grid, flux, whitening_of(np.full(6, NOISE_T)), LOW, HIGH, 0.0, chi2_limit(1, 1e-9)
    )
    good = [solution for solution in found if solution.chi2 < 50.0]
    assert len(good) > 1


def test_grid_covers_the_volume_widens_with_height_and_stays_above_the_board():
    volume = TrackedVolume((-0.1, -0.1, 0.05), (0.1, 0.1, 0.3))
    points = grid_points(volume, 0.03)
    assert (points.min(axis=0) == volume.low).all()
    np.testing.assert_allclose(points.max(axis=0), volume.high)
    heights = np.unique(points[:, 2])
    counts = [np.count_nonzero(points[:, 2] == z) for z in heights]
    assert counts == sorted(counts, reverse=True)
    assert np.diff(heights)[0] < np.diff(heights)[-2]
    assert volume.contains(np.array([0.0, 0.0, 0.1]))
    assert not volume.contains(np.array([0.0, 0.0, 0.31]))
    assert not volume.contains(np.full(3, np.nan))
    around = grid_points(TrackedVolume((-0.3, -0.3, 0.1), (0.3, 0.3, 0.7)), 0.03, [0.0, 0.0, 0.4])
    for middle in np.array([[0.0, 0.0, 0.3], [0.0, 0.2, 0.4], [0.2, 0.1, 0.55]]):
        assert np.linalg.norm(around - middle, axis=1).min() < 0.04
    low, high = TrackedVolume((-0.1, -0.1, 0.02), (0.1, 0.1, 0.3)).grown(0.05)
    assert low[2] == pytest.approx(0.01)
    np.testing.assert_allclose(high, [0.15, 0.15, 0.35])


def test_grids_and_starts_that_are_none_are_refused():
    with pytest.raises(TrackingError, match='low < high'):
        TrackedVolume((0.0, 0.0, 0.1), (0.1, 0.1, 0.1))
    with pytest.raises(TrackingError, match='low < high'):
        TrackedVolume((0.0, 0.0, np.nan), (0.1, 0.1, 0.1))
    with pytest.raises(TrackingError, match='must be positive'):
        grid_points(VOLUME, 0.0)
    with pytest.raises(TrackingError, match='too fine'):
        grid_points(VOLUME, 1e-3)


def test_of_an_information_that_is_not_finite_nothing_is_known():
    np.testing.assert_array_equal(bounded_inverse(np.full((6, 6), np.nan)), np.eye(6))
