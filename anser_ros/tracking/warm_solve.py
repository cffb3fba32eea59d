"""Solves all coils of a frame near where they are expected, in one call of compiled code.

One by one, calling the kernels takes longer than what they calculate. The lock of the interpreter
is kept: who gives it away in the middle of a frame waits for another thread's turn to end.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.kernel_cache import kernel
from anser_ros.stamps import NANO
from anser_ros.tracking.coil_track import (
    UNKNOWNS,
    CoilTrack,
    Start,
    take_errors,
    whitening_at,
)
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


def expected_poses(
    tracks: list[CoilTrack],
    lengths: Array,
    stamp_ns: int,
    context: SolveContext,
    settings: TrackerSettings,
) -> list[Start | None]:
    """Return where each sensor is expected, None where nowhere, and take the model's error there.

    For all coils together this takes a third of the time.
    """
    starts = [
        None if (stamp_ns - track.good_ns) * NANO > settings.warm_age_s
        else track.expected(stamp_ns)
        for track in tracks
    ]  # fmt: skip
    if context.modes is None:
        return starts
    far = {
        i: start
        for i, (track, start) in enumerate(zip(tracks, starts, strict=True))
        if start is not None and not (track.error and track.error.holds(context, *start))
    }
    if far:
        rows = list(far)
        points, axes = (np.array(part) for part in zip(*far.values(), strict=True))
        for i, error in zip(rows, take_errors(context, points, axes, lengths[rows]), strict=True):
            tracks[i].error = error
    return starts


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

    Parameters
    ----------
    tracks : list of CoilTrack
    lengths : ndarray, shape (S,)
        Of the coils, m.
    stamp_ns : int
    values : ndarray, shape (S, 2K)
        Flux components, T.
    sound : ndarray of bool, shape (S,)
        Which readings can be used.
    context : SolveContext
    settings : TrackerSettings
    """
    solutions: list[CoilSolution | None] = [None] * len(tracks)
    starts = expected_poses(tracks, lengths, stamp_ns, context, settings)
    given = [
        (i, start, whitening_at(tracks[i], context, *start, float(lengths[i])))
        for i, (start, good) in enumerate(zip(starts, sound.tolist(), strict=True))
        if start is not None and good and context.readings >= UNKNOWNS
    ]
    if not given:
        return solutions
    rows = [i for i, _, _ in given]
    positions = np.array([start[0] for _, start, _ in given])
    axes = np.array([start[1] for _, start, _ in given])
    weights = np.array([whitening for _, _, whitening in given])
    count, width = len(rows), values.shape[1]
    normals, residuals = np.empty((count, 6, 6)), np.empty((count, width))
    found, field = np.empty((count, 3)), context.field
    descend_all(
        positions, axes, lengths[rows], values[rows], weights, field.columns, field.moments,
        context.low, context.high, MAX_EVALUATIONS, normals, residuals, found,
    )  # fmt: skip
    for i, position, axis, normal, residual, (chi2, used, converged) in zip(
        rows, positions, axes, normals, residuals, found.tolist(), strict=True
    ):
        solutions[i] = CoilSolution(
            position, axis, chi2, normal, residual, int(used), bool(converged)
        )
    return solutions
