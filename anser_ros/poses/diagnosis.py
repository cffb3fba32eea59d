"""Diagnoses a session of poses: convention, hand-eye, search, and what held-out poses say.

The stages are those of a diagnosis of fluxes: read and set up, search on four fifths of the blocks
of time, judge on the fifth that took no part; then the parameters are fitted to all poses.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import PlausibilityError
from anser_ros.field.model import EffectRecord
from anser_ros.poses.convention import read_rightly
from anser_ros.poses.effect import PoseResiduals, PoseTerm, Role, Sensing
from anser_ros.poses.fit import (
    PoseFit,
    fit_poses,
    noise_of,
    with_time_constants,
)
from anser_ros.poses.held_out import HeldOutErrors, errors_of, held_out, judged
from anser_ros.poses.jitter import floor_of
from anser_ros.poses.lever_arms import (
    knows_levers,
    most_poses,
)
from anser_ros.poses.prices import LEAST_MAP_M
from anser_ros.poses.problem import PoseProblem, PoseState
from anser_ros.poses.records import records_of
from anser_ros.poses.registry import pose_effects
from anser_ros.poses.search import PoseSearch, frame_terms, search_effects
from anser_ros.poses.sequence import PoseSession
from anser_ros.poses.start import (
    coarse_offset,
    first_fit,
    pose_problem,
    train_blocks,
)
from anser_ros.poses.structure import depends_on
from anser_ros.poses.swaps import put_back, swapped_spans, untangled

Array = NDArray[np.float64]

ABOVE_FLOOR = 1.3
"""Factor of the held-out error over the jitter from which something stays unexplained. What is no
jitter is then 0.8 of it (the root of 1.3 squared less one)."""

LEAST_REPORTED_M = 0.3e-3
"""Held-out error, m, below which nothing is said to be unexplained: no tracker promises less. Of
one place at rest, which jitters by micrometres, something always is."""


@dataclass(frozen=True)
class PoseDiagnosis:
    """Holds what a session of poses was found to contain."""

    session: PoseSession  # as it is meant (units, order of quaternions)
    fit: PoseFit  # the two frames and all effects, on all poses
    records: tuple[EffectRecord, ...]  # the effects that are named
    # Held out: with the registration alone, with hand-eye, with the effects.
    registered: HeldOutErrors
    before: HeldOutErrors
    after: HeldOutErrors
    floor_m: float  # what jitter alone would leave, m
    unexplained: float  # share of the squared error above the jitter that stays
    depends_on: tuple[str, ...]
    refused: tuple[tuple[str, str], ...]
    states: tuple[PoseState, PoseState]  # the held-out poses before and after
    left_out: tuple[str, ...]  # sensors that have too few poses at times with a reference
    # Whether the motion determines enough of a lever arm to look for effects of place.
    knows_levers: bool


def diagnose_poses(
    session: PoseSession, progress: Callable[[str], None] | None = None
) -> PoseDiagnosis:
    """Find what a tracker of poses lacks on a session.

    Raises `DiagnosisError` when there are too few poses with a reference.
    Raises `PlausibilityError` when tracked and optical poses fit in no reading.
    """
    say = progress or (lambda text: None)
    say('conventions')
    exchanged: list[EffectRecord] = []
    try:
        session, convention = read_rightly(session)
    except PlausibilityError:
        # Nothing fits all of a session whose sensors were exchanged for half of it.
        session, exchanged = untangled(session)
        if not exchanged:
            raise
        session, convention = read_rightly(session)
    problem = pose_problem(session)
    train, test = train_blocks(problem)
    say('hand-eye')
    alone = session.reference is None
    training = problem.in_blocks(train)
    first = first_fit(training, coarse_offset(training), alone)
    swaps = swapped_spans(problem, first)
    session, swapped = put_back(session, swaps)
    if swaps:
        problem = pose_problem(session)
        training = problem.in_blocks(train)
        first = first_fit(training, coarse_offset(training), alone)
    search = search_effects(first, session, say)
    say('held out')
    state = search.fit.state
    # A clock may stand for what else there is besides jitter.
    if not search.knows_levers and state.rms()[0] > ABOVE_FLOOR * floor_of(state):
        alone_fit = fit_poses(state.problem, frame_terms(search.fit.terms))
        search = replace(search, fit=alone_fit, evidence=(None,) * len(alone_fit.terms))
    search = _confirmed(search, problem, test)
    found = search.fit
    whole = with_time_constants(fit_poses(judged(problem, found), found.terms))
    before, after, registered = held_out(problem, found, test)
    floor = floor_of(after)
    residuals = _residuals(session, problem, whole)
    records = records_of(whole, search.evidence, session)
    is_known = search.knows_levers and knows_levers(whole, most_poses(session))
    for effect in pose_effects().values():
        if effect.needs_levers and not is_known:
            continue
        words = {'summary': effect.summary, 'advice': effect.advice}
        records += [
            replace(r, evidence={**words, **r.evidence}) for r in effect.observed(residuals)
        ]
    records += [*exchanged, *swapped]
    if convention is not None:
        records.append(convention)
    errors = errors_of(after)
    excess = max(errors.position_m**2 - floor**2, 0.0)
    possible = max(errors_of(before).position_m ** 2 - floor**2, excess, 1e-18)
    significant = errors.position_m > max(ABOVE_FLOOR * floor, LEAST_REPORTED_M)
    return PoseDiagnosis(
        session=session,
        fit=whole,
        records=tuple(records),
        registered=registered,
        before=errors_of(before),
        after=errors,
        floor_m=floor,
        unexplained=excess / possible if significant else 0.0,
        depends_on=(depends_on(after) or depends_on(whole.state)) if significant else (),
        refused=search.refused,
        states=(before, after),
        left_out=tuple(
            name
            for name, poses in session.sensors.items()
            if poses is not most_poses(session) and name not in problem.setting.sensors
        ),
        knows_levers=search.knows_levers,
    )


def _confirmed(search: PoseSearch, problem: PoseProblem, test: NDArray[np.int64]) -> PoseSearch:
    """The search without effects of place that positions do not confirm."""
    fit = search.fit
    for index, term in enumerate(fit.terms):
        if not term.effect.blocks_in_space:
            continue
        rest = fit_poses(fit.state.problem, [t for t in fit.terms if t is not term])
        why = unconfirmed(rest, fit, term, judged(problem.in_blocks(test), fit))
        if why:
            evidence = tuple(e for k, e in enumerate(search.evidence) if k != index)
            refused = (*search.refused, (term.label, why))
            left = replace(search, fit=rest, evidence=evidence, refused=refused)
            return _confirmed(left, problem, test)
    return search


def unconfirmed(rest: PoseFit, fit: PoseFit, term: PoseTerm, unseen: PoseProblem) -> str:
    """Return why an effect of place is not believed beside the rest; empty where it is.

    ``rest`` is the fit without it, and ``unseen`` the held-out poses.

    Poses near each other err alike, and a few places may ask for what no others confirm. Where
    stamps jitter, an error of places weighs little beside one across the velocity or of turns; a
    map that moves poses but takes nothing off their errors makes up for frames that it has moved.
    """
    if _square(unseen.state(rest.terms), term) < _square(unseen.state(fit.terms), term):
        return 'held-out poses are worse with it'
    taken = _square(rest.state, term) - _square(fit.state, term)
    if term.role is Role.MAP and taken < LEAST_MAP_M**2:
        return f'takes less than {1e3 * LEAST_MAP_M:g} mm off the errors of positions'
    return ''


def _square(state: PoseState, term: PoseTerm) -> float:
    """Mean squared error of the positions, m^2, of the sensors that a term is about."""
    parts = [p for p in state.parts if term.acts_on(p.view.sensor)]
    total = sum(float(np.sum(p.residual[p.used, :3] ** 2)) for p in parts)
    return total / max(sum(np.count_nonzero(p.used) for p in parts), 1)


def _residuals(session: PoseSession, problem: PoseProblem, whole: PoseFit) -> PoseResiduals:
    """What the last fit leaves; what stands out of it, and not of the one before, is out."""
    known, sensings = judged(problem, whole), []
    for part, weight in zip(known.state(whole.terms).parts, known.weight, strict=True):
        noise, cost = noise_of(part)
        gain = noise_of(part, with_stamps=False)[1] - cost
        sensings.append(
            Sensing(
                part.view, part.residual, part.used, weight == 0.0, noise.position_m,
                noise.orientation_rad, noise.stamp_s, gain,
            )
        )  # fmt: skip
    return PoseResiduals(session, problem.setting, tuple(sensings))
