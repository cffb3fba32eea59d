"""Judges a fit by poses that took no part in it.

Every fifth block of time is held out of a search. Recordings at rest are few, and a fifth of them
says little: each is judged by a fit of others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.prepare import TEST_EVERY
from anser_ros.poses.effect import PoseView
from anser_ros.poses.fit import PoseFit, fit_poses, unexplained_poses
from anser_ros.poses.problem import PosePart, PoseProblem, PoseState
from anser_ros.poses.search import frame_terms
from anser_ros.poses.start import frames_from_places

Array = NDArray[np.float64]

FEWEST_RECORDINGS = 8
"""Recordings at rest from which each is judged by a fit of others: of fewer the rest does not
determine all frames."""


@dataclass(frozen=True)
class HeldOutErrors:
    """Holds held-out errors of all sensors, and by sensor: distance (m) and angle (rad), rms."""

    position_m: float
    orientation_rad: float
    by_sensor: dict[str, tuple[float, float]]


def judged(problem: PoseProblem, fit: PoseFit) -> PoseProblem:
    """Return a problem with the noise of a fit, and without the poses that stand out from it."""
    every = tuple(np.ones(s.size) for s in problem.sensors)
    noisy = replace(problem, weight=every, noise=fit.state.problem.noise)
    out = unexplained_poses(noisy.state(fit.terms))
    return replace(noisy, weight=tuple(np.where(mask, 0.0, 1.0) for mask in out))


def errors_of(state: PoseState) -> HeldOutErrors:
    """Return the errors of a state, rms."""
    every = state.rms()
    return HeldOutErrors(*every, {p.view.sensor: state.rms(p.view.sensor) for p in state.parts})


def held_out(
    problem: PoseProblem, found: PoseFit, test: NDArray[np.int64]
) -> tuple[PoseState, PoseState, HeldOutErrors]:
    """Return held-out poses before and after, and what registration alone leaves of them."""
    folds = [(found, test)]
    if problem.path.is_at_rest and np.unique(problem.blocks[0]).size >= FEWEST_RECORDINGS:
        every, known = np.unique(np.concatenate(problem.blocks)), judged(problem, found)
        parts = [every[k::TEST_EVERY] for k in range(min(TEST_EVERY, every.size))]
        folds = [
            (fit_poses(known.in_blocks(np.setdiff1d(every, part)), found.terms), part)
            for part in parts
        ]
    before, after, squares = [], [], []
    for fit, part in folds:
        exact = tuple(replace(n, stamp_s=0.0) for n in fit.state.problem.noise)
        frames = fit_poses(replace(fit.state.problem, noise=exact), frame_terms(fit.terms))
        unseen = judged(problem.in_blocks(part), fit)
        before.append(unseen.state(frames.terms))
        after.append(unseen.state(fit.terms))
        squares.append(_registered(frames, unseen))
    first, last = _joined(before), _joined(after)
    by_sensor = {
        part.view.sensor: np.concatenate([square[k] for square in squares])
        for k, part in enumerate(last.parts)
    }

    def rms(square: Array) -> float:
        return float(np.sqrt(square.mean())) if square.size else float('nan')

    registered = HeldOutErrors(
        rms(np.concatenate(list(by_sensor.values()))),
        last.rms()[1],
        {name: (rms(square), last.rms(name)[1]) for name, square in by_sensor.items()},
    )
    return first, last, registered


def _joined(states: list[PoseState]) -> PoseState:
    """One state of several of the same sensors, in the order of time."""
    if len(states) == 1:
        return states[0]
    parts = []
    for same in zip(*(state.parts for state in states), strict=True):
        order = np.argsort(np.concatenate([p.view.time for p in same]), kind='stable')

        def put(values: Sequence[NDArray[Any]], order: NDArray[np.int64] = order) -> NDArray[Any]:
            return np.concatenate(values)[order]

        poses = {
            field.name: put([getattr(p.view, field.name) for p in same])
            for field in fields(PoseView)
            if field.name not in ('sensor', 'frame', 'lever')
        }
        parts.append(
            PosePart(
                replace(same[0].view, **poses), put([p.residual for p in same]),
                put([p.weight for p in same]), same[0].noise, put([p.blocks for p in same]),
                put([p.places for p in same]),
            )
        )  # fmt: skip
    return replace(states[0], parts=tuple(parts))


def _registered(frames: PoseFit, unseen: PoseProblem) -> list[Array]:
    """Squared distances that registering the places of each sensor alone leaves, with no lever
    arm; the rotations are those of a mount, which positions do not determine.
    """
    squares = []
    for fitted, part in zip(frames.state.parts, unseen.state(frames.terms).parts, strict=True):
        optical, place = fitted.view.optical[fitted.used], fitted.view.measured[fitted.used]
        off = part.view.measured[part.used]
        if len(place):
            rotation = frames_from_places(place, optical)
            shift = np.mean(place - optical @ rotation.T, axis=0)
            off = off - part.view.optical[part.used] @ rotation.T - shift
        squares.append(np.sum(off**2, axis=1))
    return squares
