"""Solves all coils of a frame near where they are expected, in one call of compiled code.

One by one, calling the kernels takes longer than what they calculate. The lock of the interpreter
is kept: a thread that releases it in the middle of a frame waits for another's turn to end.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.kernel_cache import kernel
from anser_ros.tracking.coil_track import UNKNOWNS, CoilTrack, take_errors, whitening_at
from anser_ros.tracking.descent import descend
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.solve import MAX_EVALUATIONS, CoilSolution
from anser_ros.tracking.solve_context import SolveContext

Array = NDArray[np.float64]


@kernel
def descend_all(  # type: ignore[no-untyped-def]
    positions, axes, lengths, fluxes, whitening, dipoles, moments, low, high, budget, normals,
    residuals, found,
):  # fmt: skip
    """Descend from a start for each coil (S of them): `descent.descend` for all rows.

    ``found`` (S, 3): chi-square, evaluations, whether it converged.
    """
    for s in range(positions.shape[0]):
        chi2, used, converged = descend(
            positions[s], axes[s], lengths[s], fluxes[s], whitening[s], dipoles, moments, low,
            high, budget, normals[s], residuals[s],
        )  # fmt: skip
        found[s, 0], found[s, 1], found[s, 2] = chi2, used, converged


def _expected(tracks: list[CoilTrack], stamp_ns: int) -> tuple[Array, Array]:
    """Positions and axes (S, 3) of sensors that move on as between their last two good poses.

    For all coils together this takes a third of the time.
    """
    good = [track.good for track in tracks if track.good is not None]
    old = [g if t.before is None else t.before[1] for t, g in zip(tracks, good, strict=True)]
    steps = np.array([track.steps(stamp_ns) for track in tracks])[:, None]
    place, last_place = (np.concatenate([s.position for s in some]) for some in (good, old))
    axis, last_axis = (np.concatenate([s.axis for s in some]) for some in (good, old))
    positions = place.reshape(-1, 3) + steps * (place - last_place).reshape(-1, 3)
    axes = axis.reshape(-1, 3) + steps * (axis - last_axis).reshape(-1, 3)
    axes /= np.where(steps > 0.0, np.sqrt((axes * axes).sum(axis=1, keepdims=True)), 1.0)
    return positions, axes


def solve_warm(
    tracks: list[CoilTrack],
    lengths: Array,
    stamp_ns: int,
    values: Array,
    sound: NDArray[np.bool_],
    context: SolveContext,
    settings: TrackerSettings,
) -> list[CoilSolution | None]:
    """Return each sensor's solution near where it is expected; None where it is nowhere.

    ``lengths`` (S,) are the coils', m; ``values`` (S, 2K) flux components, T; ``sound`` (S,) tells
    which of them can be used.
    """
    solutions: list[CoilSolution | None] = [None] * len(tracks)
    rows = [i for i in np.flatnonzero(sound).tolist() if tracks[i].fresh(stamp_ns, settings)]
    if not rows or context.readings < UNKNOWNS:
        return solutions
    followed = [tracks[i] for i in rows]
    positions, axes = _expected(followed, stamp_ns)
    spans = lengths[rows]
    if context.modes is not None:
        far = [
            k for k, track in enumerate(followed)
            if not (track.error and track.error.holds(context, positions[k], axes[k]))
        ]  # fmt: skip
        if far:
            fresh = take_errors(context, positions[far], axes[far], spans[far])
            for k, error in zip(far, fresh, strict=True):
                followed[k].error = error
    each = zip(followed, positions, axes, spans.tolist(), strict=True)
    weights = np.array([whitening_at(track, context, *start) for track, *start in each])
    count, width = len(rows), values.shape[1]
    normals, residuals = np.empty((count, 6, 6)), np.empty((count, width))
    found, field = np.empty((count, 3)), context.field
    descend_all(
        positions, axes, spans, values[rows], weights, field.columns, field.moments,
        context.low, context.high, MAX_EVALUATIONS, normals, residuals, found,
    )  # fmt: skip
    for i, position, axis, normal, residual, (chi2, used, converged) in zip(
        rows, positions, axes, normals, residuals, found.tolist(), strict=True
    ):
        solutions[i] = CoilSolution(
            position, axis, chi2, normal, residual, int(used), bool(converged)
        )
    return solutions
