"""Finds where known metal is when nothing is known of its place."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from anser_ros.known_metal.known import KnownMetal
from anser_ros.known_metal.lattice import Coils
from anser_ros.known_metal.rows import real_parts
from anser_ros.known_metal.track import Scene, posed
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.tool_readings import ToolReading, coil_spread, linearised
from anser_ros.settings import ToolSettings

Array = NDArray[np.float64]

SPACING_M = 0.08
"""Of the places that are tried: about what a track finds back from."""
APART_M = 0.15
"""Distance of starts from each other, m: two that are nearer lead to the same place, and show
nothing of whether another place explains the readings as well."""
AT_ONCE = 64
"""Places that are worked out at once."""
BEYOND_M = 0.4
"""How far beyond the places where it was learnt the metal is looked for, m: what was below the
emitters may be further below or beside them, and hardly stands over the patient."""


def places_around(volume: TrackedVolume, known: KnownMetal) -> Array:
    """Return places (P, 3), m, where known metal is looked for, all of it outside a volume."""
    ends = zip(known.low - BEYOND_M, known.high + BEYOND_M, strict=True)
    sides = [np.arange(a, b, SPACING_M) for a, b in ends]
    places = np.stack(np.meshgrid(*sides, indexing='ij'), -1).reshape(-1, 3)
    low, high = np.array(volume.low), np.array(volume.high)
    at = places[:, None] + known.lattice.points
    inside = np.asarray(((at > low) & (at < high)).all(axis=2)).any(axis=1)
    return np.asarray(places[~inside])


def likely_starts(
    scene: Scene, tools: ToolSettings, reading: ToolReading, places: Array, most: int
) -> tuple[list[Array], float]:
    """Return poses (6,) of the metal that explain a tool's readings best, the best first, apart.

    ``reading``: at a pose that is right to some centimetres. ``places`` (P, 3): to be tried, m.

    Returns
    -------
    starts : list of ndarray
    gain : float
        Logarithm of how much more likely the best one makes the readings than no metal does.
    """
    sigma = coil_spread(len(reading.table), tools)
    # What a pose that is off leaves beyond the first order would be taken for metal.
    reading = posed(scene, scene.model, reading, 0.0 * sigma, np.diag(sigma**2))
    rows = linearised(reading, scene.model, scene.model.moments, scene.turn)
    own = real_parts(rows.own) * sigma
    pose = real_parts(rows.pose)
    spread = pose @ pose.T + own @ own.T
    spread[np.diag_indices(len(spread))] += scene.noise**2
    factor = np.linalg.cholesky(spread)
    left = solve_triangular(factor, real_parts(rows.left), lower=True)
    coils = Coils(rows.at, rows.axes, reading.table.length)
    found = []
    turns = np.broadcast_to(scene.known.turn, places.shape)
    for poses in np.array_split(
        np.concatenate([places, turns], axis=1), -(-len(places) // AT_ONCE)
    ):
        fluxes = scene.setting.fluxes(scene.known.lattice, poses, coils)
        flat = np.array([real_parts(flux.ravel()) for flux in fluxes]).T / scene.noise_t
        by = solve_triangular(factor, flat, lower=True)
        # The misfit makes a strong reading of the wrong place less certain than it looks.
        power = ((left[:, None] - by) ** 2).sum(axis=0)
        power /= 1.0 + scene.misfit**2 * (by**2).mean(axis=0)
        found += list(zip(power.tolist(), poses, strict=True))
    found.sort(key=lambda one: one[0])
    starts: list[Array] = []
    for _, at in found:
        if all(np.linalg.norm(at[:3] - other[:3]) > APART_M for other in starts):
            starts.append(at)
        if len(starts) == most:
            break
    return starts, 0.5 * (float(left @ left) - found[0][0])
