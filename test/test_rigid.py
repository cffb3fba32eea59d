"""Rigid tools: exact poses, cold starts, common model errors, coils that are left out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracking_world import NOISE_T, certain_model, fluxes, random_pose, triaxial_tool

from anser_ros.errors import TrackingError
from anser_ros.field.model import FieldModel, ScanGaps
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.rotations import rotation_of_vector
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.rigid import (
    BodyCoils,
    carried_on,
    fill_common,
    solve_body,
    start_from_coils,
)
from anser_ros.tracking.solve import RealField, bounded_inverse
from anser_ros.tracking.solve_context import (
    MOST_GROWTH,
    NOT_FINITE,
    build_context,
    fill_model_errors,
    growth_at,
    source_spacing,
)
from anser_ros.tracking.tracker import Tracker

SEED = 41
MODEL = certain_model()
FIELD = RealField.of(MODEL.positions, MODEL.directions, MODEL.moments)
WIDTH = FIELD.moments.shape[1]
TOOL = triaxial_tool()
COILS = BodyCoils(TOOL.position, TOOL.axis, TOOL.length)
WEIGHTS = np.full(WIDTH, 1 / NOISE_T)
ARRAYS = build_context(MODEL, TrackerSettings(flux_noise_t=NOISE_T)).arrays


def real(flux):
    return np.ascontiguousarray(flux).view(np.float64)


def solve(flux, position, rotation, coils=COILS, model=ARRAYS):
    return solve_body(coils, real(flux), model, position, rotation)


def is_common(common, modes):
    """Whether E is that of modes D (R, S 2K): ``I - E^T E`` is the inverse of ``I + D^T D``."""
    expected = np.linalg.inv(np.eye(modes.shape[1]) + modes.T @ modes)
    np.testing.assert_allclose(
        np.eye(modes.shape[1]) - common.T @ common, expected, rtol=1e-7, atol=1e-9
    )


def nearby(rng, position, rotation, move=0.01, turn=0.2):
    step, axis = rng.normal(size=(2, 3))
    start = position + move * step / np.linalg.norm(step)
    return start, rotation_of_vector(turn * axis / np.linalg.norm(axis)) @ rotation


@pytest.mark.parametrize('length', [0.0, 0.008])
def test_exact_fluxes_give_the_exact_pose(rng, length):
    tool = triaxial_tool(length_m=length)
    coils = BodyCoils(tool.position, tool.axis, tool.length)
    for _ in range(20):
        position, rotation = random_pose(rng)
        found = solve(
            fluxes(MODEL, tool, position, rotation), *nearby(rng, position, rotation), coils=coils
        )
        assert found.converged
        assert np.linalg.norm(found.position - position) < 1e-6
        np.testing.assert_allclose(found.rotation, rotation, atol=1e-5)
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)


def test_information_is_the_curvature_of_chi_square(rng):
    position, rotation = random_pose(rng)
    flux = fluxes(MODEL, TOOL, position, rotation)
    base = solve(flux, position, rotation)
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-6
        points, axes = TOOL.placed(position + step[:3], rotation_of_vector(step[3:]) @ rotation)
        moved = MODEL.flux(points, axes, TOOL.length)
        chi2 = np.sum((real(moved - flux) / NOISE_T) ** 2)
        assert chi2 == pytest.approx(base.information[i, i] * 1e-12, rel=1e-2)


def test_covariance_and_chi_square_are_what_happens(rng):
    squares, chi2 = [], []
    for _ in range(200):
        position, rotation = random_pose(rng)
        found = solve(fluxes(MODEL, TOOL, position, rotation, rng), position, rotation)
        turn = Rotation.from_matrix(found.rotation @ rotation.T).as_rotvec()
        error = np.concatenate([found.position - position, turn])
        squares.append(error @ found.information @ error)
        chi2.append(found.chi2)
    assert np.mean(squares) == pytest.approx(6.0, rel=0.15)
    assert np.mean(chi2) == pytest.approx(9 * WIDTH - 6, rel=0.05)


def test_errors_that_all_coils_share_do_not_average_out(rng):
    """The whole model off by one per cent: nine coils know no better than their model."""
    position, rotation = random_pose(rng)
    clean = fluxes(MODEL, TOOL, position, rotation)
    coils = replace(COILS, changes=np.full((1, 9), 0.01))
    found = solve(1.01 * clean, *nearby(rng, position, rotation, 1e-3, 0.01), coils)
    assert found.chi2 < 3.0
    assert np.linalg.norm(found.position - position) < 3 * np.sqrt(
        np.trace(bounded_inverse(found.information)[:3, :3])
    )
    assert solve(1.01 * clean, position, rotation).chi2 > 100.0


def test_what_coils_have_in_common_is_what_each_error_makes_of_them(rng):
    """Modes of the model, a gain of some coils, and the emitters' strengths."""
    position, rotation = random_pose(rng)
    flux = real(fluxes(MODEL, TOOL, position, rotation, rng))
    points, axes = TOOL.placed(position, rotation)
    modes = 1e-5 * rng.normal(size=(len(MODEL.positions), 2, WIDTH))
    changes = 0.01 * rng.normal(size=(1, 9))
    strengths = 1e-3 * rng.normal(size=(WIDTH, 3))
    basis = flux_basis(points, axes, TOOL.length, MODEL.positions, MODEL.directions)
    relative = (strengths[0::2] + 1j * strengths[1::2]).T
    by_strength = np.ascontiguousarray(flux.view(complex)[:, None] * relative).view(float)
    each = [np.einsum('sn,nrk->srk', basis, modes), (changes.T * flux)[:, None], by_strength]
    out = np.empty((6, flux.size))
    assert fill_common(
        position, rotation, COILS.offsets, COILS.axes, COILS.lengths, changes, flux,
        columns_of(MODEL), modes.reshape(len(modes), -1), 1.0 / WEIGHTS, strengths, out,
    )  # fmt: skip
    is_common(out, np.concatenate(np.concatenate(each, axis=1) * WEIGHTS, axis=1))


def test_motion_is_carried_on_as_it_was(rng):
    position, rotation = random_pose(rng)
    for steps in (0.5, 1.0, 2.3):
        move, turn = 0.01 * rng.normal(size=3), 0.2 * rng.normal(size=3)
        now = position + move, rotation_of_vector(turn) @ rotation
        found = carried_on(*now, position, rotation, steps)
        np.testing.assert_allclose(found[0], position + (1 + steps) * move, atol=1e-12)
        expected = rotation_of_vector((1 + steps) * turn) @ rotation
        np.testing.assert_allclose(found[1], expected, atol=1e-9)
    still = carried_on(position, rotation, position, rotation, 1.0)
    np.testing.assert_allclose(still[1], rotation, atol=1e-12)


def test_start_from_the_coils_own_poses(rng):
    position, rotation = random_pose(rng)
    points, axes = TOOL.placed(position, rotation)
    start = start_from_coils(COILS, points, axes, np.ones(9))
    assert start is not None
    np.testing.assert_allclose(start[0], position, atol=1e-12)
    np.testing.assert_allclose(start[1], rotation, atol=1e-12)
    two = COILS.subset(np.array([0, 1]))
    start = start_from_coils(two, points[:2], axes[:2], np.ones(2))
    assert start is not None
    np.testing.assert_allclose(start[1], rotation, atol=1e-12)
    assert start_from_coils(COILS.subset(np.array([0])), points[:1], axes[:1], np.ones(1)) is None
    assert (
        start_from_coils(COILS.subset(np.array([], int)), points[:0], axes[:0], np.ones(0)) is None
    )


def test_refusals():
    with pytest.raises(TrackingError, match='9 coils'):
        solve(np.zeros((8, 8), complex), np.zeros(3), np.eye(3))
    with pytest.raises(TrackingError, match='must be finite'):
        uncertain = ARRAYS._replace(
            uncertain=ARRAYS.columns, modes=np.full((len(MODEL.positions), WIDTH), np.nan)
        )
        solve(np.ones((9, 8), complex), np.array([0.0, 0.0, 0.1]), np.eye(3), COILS, uncertain)


POINT, AXIS = np.array([0.02, -0.05, 0.13]), np.array([0.6, 0.0, 0.8])


def columns_of(model):
    return RealField.of(model.positions, model.directions, model.moments).columns


def written_errors(points, axes, lengths, dipoles, spacing, modes, sigma, read=None):
    count, width = len(points), len(sigma)
    errors, near = np.empty((count, modes.shape[1] // width, width)), np.empty((count, 2))
    weights = np.empty((count, width, width))
    written = errors, weights, near
    read = read or (np.zeros((count, width)), np.empty((0, 0)))
    of = modes, sigma, *read
    is_finite = fill_model_errors(points, axes, lengths, dipoles, spacing, *of, *written)
    assert is_finite, NOT_FINITE
    return errors, weights, near[:, 0], near[:, 1]


def both(modes, sigma, length):
    model = certain_model()
    span = np.array([length])
    basis = flux_basis(POINT[None], AXIS[None], span, model.positions, model.directions)
    flux = np.ascontiguousarray(np.einsum('sn,rnk->rsk', basis, modes)).view(float)
    laid_out = np.ascontiguousarray(
        np.ascontiguousarray(modes).view(float).swapaxes(0, 1).reshape(len(model.positions), -1)
    )
    # Another coil beside it, so that the two are not mixed up.
    seen = 1e-6 * np.arange(-16.0, 16.0).reshape(2, 16)
    strengths = 1e-4 * np.random.default_rng(2).normal(size=(16, 3))
    errors, weights, away, among = written_errors(
        np.stack([POINT + 0.01, POINT]), np.stack([AXIS[::-1], AXIS]), np.array([0.0, length]),
        columns_of(model), np.full(len(model.positions), 0.03), laid_out, sigma, (seen, strengths),
    )  # fmt: skip
    distance = np.linalg.norm(model.positions - POINT, axis=1).min()
    assert away[1] == pytest.approx(distance)
    assert among[1] == pytest.approx(0.03 / distance)
    np.testing.assert_allclose(errors[1], flux[:, 0], rtol=1e-9, atol=1e-20)
    covariance = np.diag(sigma**2) + flux[:, 0].T @ flux[:, 0]
    relative = strengths[0::2] + 1j * strengths[1::2]
    by_strength = (seen.view(complex)[1][:, None] * relative).T.copy().view(float)
    covariance += by_strength.T @ by_strength
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
    with np.errstate(all='ignore'), pytest.raises(AssertionError, match='finite'):
        written_errors(
            POINT[None], AXIS[None], np.zeros(1), columns_of(model), np.zeros(count),
            np.ascontiguousarray(laid_out), np.full(16, 60e-12),
        )  # fmt: skip


def test_dipoles_are_as_far_apart_as_their_nearest_neighbours_elsewhere():
    places = np.array([[0, 0, 0.1], [0, 0, 0.1], [0.03, 0, 0.1], [0.03, 0.05, 0.1], [0.03, 0, 0]])
    np.testing.assert_allclose(source_spacing(places, 0.02), [0.03, 0.03, 0.03, 0.05, 0.0])
    np.testing.assert_allclose(source_spacing(places[:2], 0.02), 0.0)


def test_the_error_that_the_field_states_by_place_is_in_sigma_and_misfit(rng):
    gaps = ScanGaps(np.array([[0.1, 0.0, 0.3]]), np.eye(3)[:1], np.array([[3e-6]]))
    model, settings = replace(MODEL, gaps=gaps, error_share=1e-3), TrackerSettings(NOISE_T)
    context, (at, rotation) = build_context(model, settings), random_pose(rng)
    corner = np.array(settings.box.high)
    for place in (corner, corner + 0.05):  # beyond the volume it is that of its edge
        error = model.error_t(np.tile(corner, (1, 3, 1)), np.eye(3)[None], np.zeros(3))
        expected = min(1.0 + np.mean(error**2) / context.sigma[0] ** 2, MOST_GROWTH)
        assert expected > 1.01
        assert growth_at.py_func(place, context.arrays) == pytest.approx(expected, rel=0.02)
    flux = fluxes(MODEL, TOOL, at, rotation, rng)
    alike, by_place = (solve(flux, at, rotation, model=m) for m in (ARRAYS, context.arrays))
    growth = growth_at.py_func(by_place.position, context.arrays)
    assert growth > 1.5 and by_place.growth == pytest.approx(growth)
    assert by_place.chi2 == pytest.approx(alike.chi2 / growth, rel=1e-6)
    np.testing.assert_allclose(by_place.covariance, growth * alike.covariance, rtol=1e-4)


def test_a_model_without_an_error_by_place_errs_alike_everywhere():
    for place in (np.array([0.0, 0.0, 0.1]), np.array([0.1, -0.1, 0.25])):
        assert growth_at.py_func(place, ARRAYS) == 1.0


@pytest.mark.parametrize(
    ('spread_m', 'floor_m', 'state'),
    [(0.0, -0.3, 'ambiguous'), (0.0, 0.05, 'ok'), (0.05, -0.3, 'ok')],
)
def test_the_opposite_place_around_a_source_is_ambiguous_where_nothing_tells_it(
    rng, spread_m, floor_m, state
):
    place = spread_m * np.array([[0.0, 0.0, 1.0], [0.0, 1.0, -0.5], [1.0, -0.5, 0.0]])
    names, tones = ('a', 'b', 'c'), (7e3, 8e3, 9e3)
    source = FieldModel(place, np.eye(3), 0.05 * np.eye(3, dtype=complex), names, tones)
    tool = TOOL.select([0, 1, 2])
    volume = TrackedVolume((-0.3, -0.3, floor_m), (0.3, 0.3, 0.3))
    tracker = Tracker(source, tool, TrackerSettings(volume=volume, flux_noise_t=NOISE_T))
    for i in range(6):
        position = np.array([0.1 * np.sin(i / 9), 0.1 * np.cos(i / 9), 0.15])
        flux = fluxes(source, tool, position, rotation_of_vector([0.3, 0.2, i / 20]), rng)
        body = {e.name: e for e in tracker.update(40_000_000 * (i + 1), tool.channel, flux)}[
            tool.body[0]
        ]
        assert body.state == state
        assert state != 'ok' or np.linalg.norm(body.position - position) < 1e-3


def few(emitters):
    return replace(
        MODEL, moments=MODEL.moments[:, :emitters], emitters=MODEL.emitters[:emitters],
        frequencies_hz=MODEL.frequencies_hz[:emitters],
    )  # fmt: skip


@pytest.mark.parametrize(('emitters', 'coils', 'row'), [(5, 1, 0), (3, 2, -1)])
def test_a_pose_that_no_reading_checks_is_not_given(emitters, coils, row):
    """One emitter more leaves readings over; how many is said."""
    for count in (emitters, emitters + 1):
        tool, rng = TOOL.select(list(range(coils))), np.random.default_rng(SEED)
        tracker = Tracker(few(count), tool, TrackerSettings(flux_noise_t=NOISE_T))
        position, rotation = np.array([0.03, -0.02, 0.12]), rotation_of_vector([0.4, 0.3, 0.2])
        for stamp_ns in (1, 2, 3):
            flux = fluxes(few(count), tool, position, rotation, rng)
            found = tracker.update(stamp_ns * 10**7, tool.channel, flux)[row]
            assert found.checks == coils * count - (5 if row == 0 else 6)
            assert (found.state == 'ok') == (found.checks > 0), found.reason


def test_without_a_check_a_pose_that_goes_on_is_as_uncertain_as_a_misfit():
    """A body of three coils loses one of them."""
    tool, rng, sigma = TOOL.select([0, 1, 2]), np.random.default_rng(SEED), []
    tracker = Tracker(few(3), tool, TrackerSettings(flux_noise_t=NOISE_T))
    for stamp_ns in range(1, 7):
        position, rotation = np.array([0.03, -0.02, 0.12]), rotation_of_vector([0.4, 0.3, 0.2])
        flux = fluxes(few(3), tool, position, rotation, rng)
        flux[2] = np.nan if stamp_ns > 3 else flux[2]
        found = tracker.update(stamp_ns * 10**7, tool.channel, flux)[-1]
        assert found.state == 'ok' and found.checks == (3 if stamp_ns < 4 else 0), found.reason
        sigma.append(found.sigma_position_m)
    assert min(sigma[3:]) > 4.0 * max(sigma[:3]), sigma


def test_without_a_check_a_single_point_has_no_pose():
    """No motion contradicts what is recorded one by one, wherever the pose before it was."""
    tool, rng = TOOL.select([0, 1, 2]), np.random.default_rng(SEED)
    tracker = Tracker(few(3), tool, TrackerSettings(flux_noise_t=NOISE_T))
    for stamp_ns in range(1, 9):
        position, rotation = np.array([0.005 * stamp_ns, -0.02, 0.12]), np.eye(3)
        flux = fluxes(few(3), tool, position, rotation, rng)
        flux[2] = np.nan if stamp_ns % 2 else flux[2]
        found = tracker.update(stamp_ns * 9 * 10**8, tool.channel, flux)[-1]
        assert found.state == ('ambiguous' if stamp_ns % 2 else 'ok'), found.reason
