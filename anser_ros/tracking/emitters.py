"""Emitters that have died: tracking goes on with those that are left.

An emitter of which no sensor has a flux (not finite, or exactly zero) has no part in the solve: it
has no weight, and the covariance grows by what it would have told.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.scene import Scene
from anser_ros.tracking.seed import build_grid
from anser_ros.tracking.solve import RealField

FEWEST_EMITTERS = 6
"""One more than a coil's pose has unknowns, so that a residual is left to judge it by."""


def living_emitters(
    flux: NDArray[np.complex128], usable: NDArray[np.bool_]
) -> NDArray[np.bool_] | None:
    """Which emitters the usable sensors hear, shape (K,); None when they hear all or none.

    Parameters
    ----------
    flux : ndarray, shape (S, K)
        T.
    usable : ndarray, shape (S,)
        Sensors whose readings are not missing or flagged.
    """
    heard = np.isfinite(flux) & (flux != 0.0)
    if heard.all():
        return None
    living: NDArray[np.bool_] = heard[usable].any(axis=0)
    return None if living.all() or not living.any() else living


@dataclass(frozen=True)
class ReducedScene:
    """A scene without its dead emitters, and what it was made from."""

    whole: Scene
    living: NDArray[np.bool_]
    scene: Scene


def without_dead(
    scene: Scene,
    living: NDArray[np.bool_],
    settings: TrackerSettings,
    previous: ReducedScene | None = None,
) -> ReducedScene:
    """The scene of the living emitters; what has not changed since ``previous`` is kept."""
    same = previous is not None and bool((previous.living == living).all())
    if same and previous is not None and previous.whole is scene:
        return previous
    kept = np.repeat(living, 2)
    field = RealField(
        scene.field.positions,
        scene.field.directions,
        np.ascontiguousarray(scene.field.moments[:, kept]),
    )
    sigma, modes, grid = np.ascontiguousarray(scene.sigma[kept]), scene.modes, None
    if same and previous is not None:
        if previous.whole.modes is scene.modes:
            modes = previous.scene.modes
        if previous.whole.grid is scene.grid:
            grid = previous.scene.grid
    if modes is not None and modes is scene.modes:
        by_mode = modes.reshape(len(modes), -1, kept.size)[:, :, kept]
        modes = np.ascontiguousarray(by_mode.reshape(len(modes), -1))
    if grid is None:
        grid = build_grid(field, sigma, settings.volume, settings.grid_spacing_m)
    reduced = replace(scene, field=field, sigma=sigma, modes=modes, grid=grid)
    return ReducedScene(scene, living, reduced)
