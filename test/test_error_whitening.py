"""The kernel that whitens by noise and model error does what the plain algebra does."""

import numpy as np
import pytest
from tracking_world import certain_model

from anser_ros.errors import TrackingError
from anser_ros.physics.dipole import flux_basis
from anser_ros.tracking.solve import RealField
from anser_ros.tracking.solve_context import error_whitening, source_spacing

POINT, AXIS = np.array([0.02, -0.05, 0.13]), np.array([0.6, 0.0, 0.8])


def columns_of(model):
    return RealField.of(model.positions, model.directions, model.moments).columns


def both(modes, sigma, length):
    model = certain_model()
    span = np.array([length])
    basis = flux_basis(POINT[None], AXIS[None], span, model.positions, model.directions)
    flux = np.ascontiguousarray(np.einsum('sn,rnk->rsk', basis, modes)).view(float)
    laid_out = np.ascontiguousarray(
        np.ascontiguousarray(modes).view(float).swapaxes(0, 1).reshape(len(model.positions), -1)
    )
    # Another coil beside it, so that the two are not mixed up.
    errors, weights, away, among = error_whitening(
        np.stack([POINT + 0.01, POINT]), np.stack([AXIS[::-1], AXIS]), np.array([0.0, length]),
        columns_of(model), np.full(len(model.positions), 0.03), laid_out, sigma,
    )  # fmt: skip
    distance = np.linalg.norm(model.positions - POINT, axis=1).min()
    assert away[1] == pytest.approx(distance)
    assert among[1] == pytest.approx(0.03 / distance)
    np.testing.assert_allclose(errors[1], flux[:, 0], rtol=1e-9, atol=1e-20)
    covariance = np.diag(sigma**2) + flux[:, 0].T @ flux[:, 0]
    return np.linalg.inv(np.linalg.cholesky(covariance)), weights[1]


def test_it_is_the_inverse_factor_of_the_covariance():
    rng = np.random.default_rng(1)
    count = len(certain_model().positions)
    modes = 1e-5 * (rng.normal(size=(5, count, 8)) + 1j * rng.normal(size=(5, count, 8)))
    sigma = rng.uniform(50e-12, 90e-12, 16)
    for length in (0.0, 0.008):
        plain, kernel = both(modes, sigma, length)
        np.testing.assert_allclose(kernel, plain, rtol=1e-8, atol=1e-9 * np.abs(plain).max())


def test_what_is_not_finite_is_refused():
    count = len(certain_model().positions)
    modes = np.full((1, count, 8), np.inf + 0j)
    model = certain_model()
    laid_out = np.ascontiguousarray(modes).view(float).swapaxes(0, 1).reshape(count, -1)
    with np.errstate(all='ignore'), pytest.raises(TrackingError, match='finite'):
        error_whitening(
            POINT[None], AXIS[None], np.zeros(1), columns_of(model), np.zeros(count),
            np.ascontiguousarray(laid_out), np.full(16, 60e-12),
        )  # fmt: skip


def test_dipoles_are_as_far_apart_as_their_nearest_neighbours_elsewhere():
    places = np.array([[0, 0, 0.1], [0, 0, 0.1], [0.03, 0, 0.1], [0.03, 0.05, 0.1], [0.03, 0, 0]])
    np.testing.assert_allclose(source_spacing(places, 0.02), [0.03, 0.03, 0.03, 0.05, 0.0])
    np.testing.assert_allclose(source_spacing(places[:2], 0.02), 0.0)
