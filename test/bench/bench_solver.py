"""Warm and cold 5-DoF solves beside scipy's least squares set up as the public tracker does."""

from collections.abc import Iterator, Sequence
from typing import Any

import harness
import numpy as np
from scipy.optimize import least_squares
from tracking_world import NOISE_T, certain_model

from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.seed import build_grid, solve_cold
from anser_ros.tracking.solve import RealField, chi2_limit, solve_coil, whitening_of

WARM_POINTS = 100
WARM_REPEATS = 5
COLD_POSES = 10_000
NEAR_M = 2e-3
LOW, HIGH = np.array([-0.125, -0.125, 0.08]), np.array([0.125, 0.125, 0.25])
BOUNDS = ([-0.5, -0.5, 0.0, -np.pi, -3 * np.pi], [0.5, 0.5, 0.5, np.pi, 3 * np.pi])
GATE_PROBABILITY = 1e-9
RIVAL = 'scipy least_squares as python-anser'


class World:
    """The drawn Anser board as 144 dipoles and 8 emitters, and random poses in its field."""

    def __init__(self) -> None:
        model = certain_model()
        self.model = model
        self.field = RealField.of(model.positions, model.directions, model.moments)
        width = self.field.moments.shape[1]
        self.whitening = whitening_of(np.full(width, NOISE_T))
        volume = TrackedVolume()
        self.low, self.high = volume.grown(0.03)
        self.grid = build_grid(self.field, np.full(width, NOISE_T), volume, 0.035)
        self.gate = chi2_limit(width - 5, GATE_PROBABILITY)

    def poses(self, rng: np.random.Generator, count: int, z: float | None = None) -> Any:
        """Positions and axes."""
        points = rng.uniform(LOW, HIGH, (count, 3))
        if z is not None:
            points[:, 2] = z
        axes = rng.normal(size=(count, 3))
        return points, axes / np.linalg.norm(axes, axis=1)[:, None]

    def fluxes(self, rng: np.random.Generator, points: Any, axes: Any) -> Any:
        """Fluxes (P, 2K) with noise."""
        flux = np.ascontiguousarray(self.model.flux(points, axes)).view(np.float64)
        return flux + NOISE_T * rng.normal(size=flux.shape)


def rival_residual(p: Any, world: World, measured: Any) -> Any:
    """Residual in tesla by x, y, z, theta, phi; in-phase and quadrature, as ours."""
    theta, phi = p[3], p[4]
    axis = np.array([[np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]])
    model = world.model
    basis = flux_basis(p[None, :3], axis, None, model.positions, model.directions)
    return (basis @ world.field.moments)[0] - measured


def rival_solve(world: World, measured: Any, start: Any) -> Any:
    """One solve as in python-anser: no scaling, differences, its tolerances and bounds."""
    return least_squares(
        rival_residual, start, args=(world, measured), method='trf', jac='2-point',
        ftol=2.3e-16, gtol=2.3e-16, xtol=1e-6, bounds=BOUNDS,
    ).x  # fmt: skip


def angles(axis: Any) -> tuple[float, float]:
    """Theta and phi of a unit axis."""
    return float(np.arccos(np.clip(axis[2], -1, 1))), float(np.arctan2(axis[1], axis[0]))


def rows_of(
    name: str, unit: str, scale: float, both: Sequence[Any], rival: str, high: int, target: float
) -> Iterator[harness.Row]:
    """Median and a high percentile of the times, s, of both ways."""
    ours, theirs = (scale * np.percentile(times, (50, high)) for times in both)
    words = f'{name}, median of {len(both[0])}', f'{name}, {high}th percentile'
    yield harness.row(words[0], float(ours[0]), unit, (rival, float(theirs[0])), target=target)
    yield harness.row(words[1], float(ours[1]), unit, (rival, float(theirs[1])))


def warm(world: World) -> Iterator[harness.Row]:
    """100 points on 25 x 25 cm at z = 15 cm, from 2 mm and 2 degrees off."""
    rng = np.random.default_rng(1)
    points, axes = world.poses(rng, WARM_POINTS, z=0.15)
    side = np.linspace(-0.125, 0.125, 10)
    points[:, 0], points[:, 1] = np.repeat(side, 10), np.tile(side, 10)
    fluxes = world.fluxes(rng, points, axes)
    ours, theirs, errors, rival_errors = [], [], [], []
    for point, axis, flux in zip(points, axes, fluxes, strict=True):
        away = rng.normal(size=3)
        start = point + 2e-3 * away / np.linalg.norm(away)
        turn = np.cross(axis, rng.normal(size=3))
        first = axis + np.radians(2.0) * turn / np.linalg.norm(turn)
        first /= np.linalg.norm(first)
        given = (world.field, flux, world.whitening, start, first, world.low, world.high)
        spent, found = harness.timed(lambda given=given: solve_coil(*given), WARM_REPEATS)
        ours.append(np.median(spent))
        errors.append(np.linalg.norm(found.position - point))
        given = world, flux, np.array([*start, *angles(first)])
        spent, p = harness.timed(lambda given=given: rival_solve(*given), WARM_REPEATS)
        theirs.append(np.median(spent))
        rival_errors.append(np.linalg.norm(p[:3] - point))
    name = 'warm 5-DoF solve, 144 dipoles x 8 emitters, complex'
    yield from rows_of(name, 'us', 1e6, (ours, theirs), RIVAL, 95, 20.0)
    worst, other = 1e3 * float(np.max(errors)), 1e3 * float(np.max(rival_errors))
    yield harness.row('warm solve, largest position error', worst, 'mm', (RIVAL, other))


def cold(world: World) -> Iterator[harness.Row]:
    """Random poses, any axis, without a guess, each once; the rival starts from one point."""
    rng = np.random.default_rng(2)
    points, axes = world.poses(rng, COLD_POSES)
    fluxes = world.fluxes(rng, points, axes)
    begins = world.low, world.high, 0.0, world.gate
    middle = np.array([0.0, 0.0, 0.2, 0.0, 0.0])

    def ours(flux: Any) -> Any:
        found = solve_cold(world.field, world.grid, flux, world.whitening, *begins)
        return found[0].position

    def theirs(flux: Any) -> Any:
        return rival_solve(world, flux, middle)[:3]

    times, errors = np.empty((2, COLD_POSES)), np.empty((2, COLD_POSES))
    for way, solve in enumerate((ours, theirs)):
        for i, flux in enumerate(fluxes):
            (times[way, i],), found = harness.timed(lambda flux=flux, solve=solve: solve(flux))
            errors[way, i] = np.linalg.norm(found - points[i])
    name = 'cold 5-DoF solve, any axis, 25 x 25 cm, z 8 to 25 cm'
    rival = 'least_squares from [0, 0, 0.2, 0, 0], the same poses'
    yield from rows_of(name, 'ms', 1e3, times, rival, 99, 0.35)
    near, other = (100.0 * float(share) for share in np.mean(errors < NEAR_M, axis=1))
    yield harness.row(
        'cold solve, poses within 2 mm', near, '%', (rival, other), target=100.0, target_is='least'
    )
    worst, other = (1e3 * float(value) for value in errors.max(axis=1))
    yield harness.row('cold solve, largest position error', worst, 'mm', (rival, other))


def rows() -> Iterator[harness.Row]:
    """Rows of the table."""
    world = World()
    rng = np.random.default_rng(3)
    points, axes = world.poses(rng, 1)
    flux = world.fluxes(rng, points, axes)[0]
    solve_cold(world.field, world.grid, flux, world.whitening, world.low, world.high)
    yield from warm(world)
    yield from cold(world)
