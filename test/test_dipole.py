"""Dipole kernels.

| what                              | must agree with                                   |
|-----------------------------------|---------------------------------------------------|
| field of a dipole                 | magpylib; closed form on the axis and the equator |
| gradient                          | central differences; symmetric; traceless         |
| flux of a point sensor            | n . B                                             |
| flux of a finite coil             | scalar potential difference; magpylib's line mean |
| flux_jacobian                     | central differences, complex                      |
| coupling of two dipoles           | the same with both exchanged (reciprocity)        |
| field turned with its source      | turned field                                      |
"""

import magpylib
import numpy as np
import pytest
from metal_world import dipole_field, dipole_gradient

from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.physics.dipole import field_basis, flux_basis, flux_jacobian

SEED = 11


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
