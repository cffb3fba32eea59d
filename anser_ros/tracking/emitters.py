"""Continues tracking with the remaining emitters after others have failed.

An emitter of which no sensor has a flux (not finite, or exactly zero) has no part in the solve: it
has no weight, and the covariance grows accordingly.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.tracking.solve import RealField
from anser_ros.tracking.solve_context import SolveContext

FEWEST_EMITTERS = 6
"""One more than a coil's pose has unknowns, so that a residual is left to judge it by."""


@dataclass(frozen=True)
class ReducedScene:
    """Holds a context without its dead emitters, and what it was made from."""

    whole: SolveContext
    living: NDArray[np.bool_]
    context: SolveContext


def without_dead(
    context: SolveContext,
    living: NDArray[np.bool_],
    previous: ReducedScene | None = None,
) -> ReducedScene:
    """Return the context of the living emitters; what has not changed since ``previous`` is
    kept.
    """
    same = previous is not None and bool((previous.living == living).all())
    if same and previous is not None and previous.whole is context:
        return previous
    kept = np.repeat(living, 2)
    field = RealField(
        context.field.positions,
        context.field.directions,
        np.ascontiguousarray(context.field.moments[:, kept]),
    )
    sigma, starts, modes = context.sigma[kept], context.starts.anew(), context.modes
    if same and previous is not None:
        starts = previous.context.starts.following()
    if same and previous is not None and previous.whole.modes is modes:
        modes = previous.context.modes
    elif modes is not None:
        modes = modes.of_components(kept)
    reduced = replace(context, field=field, sigma=sigma, modes=modes, starts=starts)
    return ReducedScene(context, living, reduced)
