"""The joint fit's normal equations against the same written out whole, with every covariance."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg

from anser_ros.arrays import as_real
from anser_ros.calibration import joint_system
from anser_ros.calibration.joint_system import JointSystem, open_directions, tied_parts
from anser_ros.calibration.least_squares import STRIP, NormalFactor, subtract_gram
from anser_ros.parallel import shared_among

FRAMES, SENSORS, EMITTERS, MODES, PARAMETERS = 45, 3, 2, 5, 3
PARTS = 2 * EMITTERS
NOISE_T = 2.0
JITTER = np.array([1.0, 2.0, 0.5, 1.0, 1.5, 0.7])


class Part:
    """Frames of a body, of which the fake parameters only need to know which ones."""

    def __init__(self, rows):
        self.rows = rows

    def frames(self, block):
        return Part(self.rows[block])


class Parameters:
    def __init__(self, columns):
        self.columns = columns

    def __len__(self):
        return self.columns.shape[2]

    def derivatives(self, part, *_):
        return self.columns[part.rows]


@pytest.fixture
def world(monkeypatch):
    """Readings whose imaginary parts depend on the poses a thousand times less."""
    monkeypatch.setattr(joint_system, 'velocity_of', lambda part: np.zeros((len(part.rows), 6)))
    rng = np.random.default_rng(5)
    slope = rng.standard_normal((FRAMES, SENSORS, PARTS, 6))
    slope[:, :, 1::2] *= 1e-3
    by = np.zeros((FRAMES, SENSORS, 3, EMITTERS), complex)
    linear = SimpleNamespace(
        part=Part(np.arange(FRAMES)), residual=rng.standard_normal((FRAMES, SENSORS, PARTS)),
        slope=slope, rows=rng.standard_normal((FRAMES, SENSORS, MODES)),
        flux=by[:, :, 0], by_place=by, by_axis=by,
    )  # fmt: skip
    shape = (FRAMES, SENSORS, PARAMETERS, EMITTERS)
    columns = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    weights = rng.uniform(0.2, 1.0, (FRAMES, SENSORS))
    share = rng.uniform(0.3, 1.0, FRAMES)
    return linear, Parameters(columns), weights, share, rng.standard_normal((MODES, PARTS))


def eliminated(world, tied, precision):
    linear, parameters, weights, share, pull = world
    along = open_directions(linear, weights, NOISE_T, JITTER, share)
    system = JointSystem(parameters, SimpleNamespace(size=np.ones(MODES)), tied)
    system.add(linear, weights, NOISE_T, along)
    return system.eliminate(precision, pull)


def written_out(world, precision):
    """Information and gradient of the parameters, and the field's variances, densely."""
    linear, parameters, weights, share, pull = world
    fields = PARTS * MODES
    normal = np.zeros((fields + PARAMETERS, fields + PARAMETERS))
    right = np.zeros(fields + PARAMETERS)
    for f in range(FRAMES):
        design = np.zeros((SENSORS, PARTS, fields + PARAMETERS))
        for part in range(PARTS):
            design[:, part, part * MODES : (part + 1) * MODES] = linear.rows[f]
        design[:, :, fields:] = np.moveaxis(as_real(parameters.columns[f]), 1, 2)
        design = design.reshape(-1, design.shape[2])
        noise = NOISE_T**2 * np.repeat(1.0 / weights[f], PARTS)
        slope = linear.slope[f].reshape(-1, 6)
        covariance = np.diag(noise) + slope @ np.diag(share[f] * JITTER**2) @ slope.T
        weighted = np.linalg.solve(covariance, design)
        normal += design.T @ weighted
        right += weighted.T @ linear.residual[f].ravel()
    normal[:fields, :fields] += np.diag(np.tile(precision, PARTS))
    right[:fields] += np.tile(precision, PARTS) * pull.T.ravel()
    inner, across = normal[:fields, :fields], normal[:fields, fields:]
    information = normal[fields:, fields:] - across.T @ np.linalg.solve(inner, across)
    gradient = right[fields:] - across.T @ np.linalg.solve(inner, right[:fields])
    variance = np.diag(np.linalg.inv(inner)).reshape(PARTS, MODES).T
    return information, gradient, variance


@pytest.mark.parametrize('tied', [[1, 1, 1, 1], [1, 0, 1, 0]])
def test_the_field_is_eliminated_as_from_the_matrices_written_out(world, tied):
    precision = np.linspace(0.1, 2.0, MODES)
    found = eliminated(world, np.array(tied, dtype=bool), precision)
    information, gradient, variance = written_out(world, precision)
    # Of the greatest; what poses do to parts that are not tied, a thousandth here, is left out.
    within = 1e-9 if all(tied) else 1e-3
    for one, other in (
        (found.information, information),
        (found.gradient, gradient),
        (found.field_variance, variance),
    ):
        assert np.abs(one - other).max() <= within * np.abs(other).max()
    # The stretches' scores are the gradient without the prior's pull.
    linear, parameters, weights, share, pull = world
    unpulled = written_out((linear, parameters, weights, share, 0.0 * pull), precision)[1]
    assert np.abs(found.scores.sum(axis=0) - unpulled).max() <= within * np.abs(gradient).max()


def test_parts_that_poses_hardly_change_are_not_tied(world):
    linear, _, weights, share, _ = world
    along = open_directions(linear, weights, NOISE_T, JITTER, share)
    assert tied_parts([along]).tolist() == [True, False, True, False]
    turned = along[..., ::-1]
    assert tied_parts([along, turned]).all(), 'a part that one body ties is tied'
    empty = along[:0]
    assert tied_parts([along, empty]).tolist() == [True, False, True, False]
    none = eliminated(world, np.zeros(PARTS, dtype=bool), np.ones(MODES))
    assert np.isfinite(none.information).all()


SIZES = (1, 7, STRIP, STRIP + 1, 3 * STRIP - 5)


def equations(size):
    rng = np.random.default_rng(size)
    rows = rng.standard_normal((size + 20, size)) * np.logspace(0, -4, size)
    return rows.T @ rows, rng.standard_normal((size, 3))


def relative(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize('size', SIZES)
def test_solution_and_diagonal_are_scipy_s(size):
    matrix, right = equations(size)
    factor = NormalFactor(np.triu(matrix))
    inverse = scipy.linalg.inv(matrix)
    assert relative(factor.solve(right), scipy.linalg.solve(matrix, right)) < 1e-6
    np.testing.assert_allclose(factor.inverse_diagonal(), np.diag(inverse), rtol=1e-6)


def test_threads_change_no_bit():
    matrix, right = equations(SIZES[-1])
    found = []
    for count in (1, 2, 3):
        with shared_among(count):
            out = np.triu(matrix) + 10.0 * np.eye(len(matrix))
            subtract_gram(out, 1e-2 * right.T)
            factor = NormalFactor(out)
            found.append((factor.solve(right), factor.inverse_diagonal()))
    for one in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(one, found[0], strict=True))


def test_a_matrix_that_is_not_positive_definite_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        NormalFactor(np.diag([1.0, -1.0]))
