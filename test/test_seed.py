"""Cold starts: any pose without a guess, and what is said when there is more than one."""

import numpy as np
import pytest
from tracking_world import NOISE_T, certain_model

from anser_ros.errors import TrackingError
from anser_ros.field.nominal import nominal_model
from anser_ros.physics.board import build_board
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.seed import build_grid, grid_points, solve_cold
from anser_ros.tracking.solve import RealField, chi2_limit, whitening_of

SEED = 31
MODEL = certain_model()
FIELD = RealField.of(MODEL.positions, MODEL.directions, MODEL.moments)
WIDTH = FIELD.moments.shape[1]
SIGMA = np.full(WIDTH, NOISE_T)
WHITENING = whitening_of(SIGMA)
VOLUME = TrackedVolume()
LOW, HIGH = VOLUME.grown(0.03)
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


def test_grid_covers_the_volume_and_widens_with_height():
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


def test_the_box_stays_above_the_boards_plane():
    low, high = TrackedVolume((-0.1, -0.1, 0.02), (0.1, 0.1, 0.3)).grown(0.05)
    assert low[2] == pytest.approx(0.01)
    np.testing.assert_allclose(high, [0.15, 0.15, 0.35])


def test_refusals():
    with pytest.raises(TrackingError, match='low < high'):
        TrackedVolume((0.0, 0.0, 0.1), (0.1, 0.1, 0.1))
    with pytest.raises(TrackingError, match='low < high'):
        TrackedVolume((0.0, 0.0, np.nan), (0.1, 0.1, 0.1))
    with pytest.raises(TrackingError, match='must be positive'):
        grid_points(VOLUME, 0.0)
    with pytest.raises(TrackingError, match='too fine'):
        grid_points(VOLUME, 1e-3)
