"""Warm and cold 5-DoF solves beside scipy's least squares set up as the public tracker does."""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

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
BOUNDS = (
    [-0.5, -0.5, 0.0, -np.pi, -3 * np.pi],
    [0.5, 0.5, 0.5, np.pi, 3 * np.pi],
)
GATE_PROBABILITY = 1e-9


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


def repeated(solve: Callable[[], Any]) -> tuple[float, Any]:
    """Median time (s) of some solves of one pose, the same number for everybody, and a result."""
    times = []
    for _ in range(WARM_REPEATS):
        begin = time.perf_counter()
        found = solve()
        times.append(time.perf_counter() - begin)
    return float(np.median(times)), found


def warm(world: World) -> list[dict[str, Any]]:
    """100 points on 25 x 25 cm at z = 15 cm, from 2 mm and 2 degrees off."""
    rng = np.random.default_rng(1)
    points, axes = world.poses(rng, WARM_POINTS, z=0.15)
    side = np.linspace(-0.125, 0.125, 10)
    points[:, 0], points[:, 1] = np.repeat(side, 10), np.tile(side, 10)
    fluxes = world.fluxes(rng, points, axes)
    ours, rival, errors, rival_errors = [], [], [], []
    for point, axis, flux in zip(points, axes, fluxes, strict=True):
        away = rng.normal(size=3)
        start = point + 2e-3 * away / np.linalg.norm(away)
        turn = np.cross(axis, rng.normal(size=3))
        first = axis + np.radians(2.0) * turn / np.linalg.norm(turn)
        first /= np.linalg.norm(first)
        given = (world.field, flux, world.whitening, start, first, world.low, world.high)
        spent_s, found = repeated(lambda given=given: solve_coil(*given))
        ours.append(spent_s)
        errors.append(np.linalg.norm(found.position - point))
        guess = np.array([*start, *angles(first)])
        spent_s, p = repeated(lambda flux=flux, guess=guess: rival_solve(world, flux, guess))
        rival.append(spent_s)
        rival_errors.append(np.linalg.norm(p[:3] - point))
    name = 'warm 5-DoF solve, 144 dipoles x 8 emitters, complex'
    told = 'scipy least_squares as python-anser'
    return [
        {
            'name': f'{name}, median of {WARM_POINTS}', 'value': 1e6 * float(np.median(ours)),
            'unit': 'us', 'rival': told, 'rival_value': 1e6 * float(np.median(rival)),
            'target': 20.0,
        },
        {
            'name': f'{name}, 95th percentile', 'value': 1e6 * float(np.percentile(ours, 95)),
            'unit': 'us', 'rival': told, 'rival_value': 1e6 * float(np.percentile(rival, 95)),
        },
        {
            'name': 'warm solve, largest position error', 'value': 1e3 * float(np.max(errors)),
            'unit': 'mm', 'rival': told, 'rival_value': 1e3 * float(np.max(rival_errors)),
        },
    ]  # fmt: skip


def cold(world: World) -> list[dict[str, Any]]:
    """Random poses, any axis, without a guess, each once; the rival starts from one point."""
    rng = np.random.default_rng(2)
    points, axes = world.poses(rng, COLD_POSES)
    fluxes = world.fluxes(rng, points, axes)
    times, errors = np.empty(COLD_POSES), np.empty(COLD_POSES)
    for i, flux in enumerate(fluxes):
        begin = time.perf_counter()
        found = solve_cold(
            world.field, world.grid, flux, world.whitening, world.low, world.high, 0.0, world.gate
        )
        times[i] = time.perf_counter() - begin
        errors[i] = np.linalg.norm(found[0].position - points[i])
    rival, rival_errors = [], []
    for point, flux in zip(points, fluxes, strict=True):
        begin = time.perf_counter()
        p = rival_solve(world, flux, np.array([0.0, 0.0, 0.2, 0.0, 0.0]))
        rival.append(time.perf_counter() - begin)
        rival_errors.append(np.linalg.norm(p[:3] - point))
    name = 'cold 5-DoF solve, any axis, 25 x 25 cm, z 8 to 25 cm'
    told = 'least_squares from [0, 0, 0.2, 0, 0], the same poses'
    return [
        {
            'name': f'{name}, median of {COLD_POSES}', 'value': 1e3 * float(np.median(times)),
            'unit': 'ms', 'rival': told, 'rival_value': 1e3 * float(np.median(rival)),
            'target': 0.35,
        },
        {
            'name': f'{name}, 99th percentile', 'value': 1e3 * float(np.percentile(times, 99)),
            'unit': 'ms', 'rival': told, 'rival_value': 1e3 * float(np.percentile(rival, 99)),
        },
        {
            'name': 'cold solve, poses within 2 mm',
            'value': 100.0 * float(np.mean(errors < NEAR_M)), 'unit': '%', 'rival': told,
            'rival_value': 100.0 * float(np.mean(np.array(rival_errors) < NEAR_M)),
            'ratio': None, 'target': 100.0, 'target_is': 'least',
        },
        {
            'name': 'cold solve, largest position error', 'value': 1e3 * float(errors.max()),
            'unit': 'mm', 'rival': told, 'rival_value': 1e3 * float(np.max(rival_errors)),
        },
    ]  # fmt: skip


def rows() -> Iterator[dict[str, Any]]:
    """Rows of the table."""
    world = World()
    rng = np.random.default_rng(3)
    points, axes = world.poses(rng, 1)
    flux = world.fluxes(rng, points, axes)[0]
    solve_cold(world.field, world.grid, flux, world.whitening, world.low, world.high)
    yield from warm(world)
    yield from cold(world)
