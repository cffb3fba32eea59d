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
    unexplained_poses,
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
"""Factor of the held-out error over the jitter from which something stays unexplained: jitter is
what differs between neighbours, and errors of a tracker are never quite alike there. What is no
jitter is then 0.8 of it (the root of 1.3 squared less one); less than that moves no pose by as
much as it jitters. Smaller always leaves something unexplained; larger says of half-explained
sessions that all is well."""

LEAST_TOLD_M = 0.3e-3
"""Held-out error, m, below which nothing is said to be unexplained: no tracker promises less. Of
one place at rest, which jitters by micrometres, something always is."""


@dataclass(frozen=True)
class PoseDiagnosis:
    """Holds what a session of poses was found to contain.

    Attributes
    ----------
    session : PoseSession
        As it is meant (units, order of quaternions).
    fit : PoseFit
        The two frames and all effects, on all poses.
    records : tuple of EffectRecord
        The effects that are named.
    evidence : mapping of str to PoseEvidence
        By the label of the term.
    registered, before, after : HeldOutErrors
        Held out: with the registration alone, with hand-eye, with the effects.
    floor_m : float
        What jitter alone would leave, m.
    unexplained : float
        Share of the squared error above the jitter that stays.
    depends_on : tuple of str
    refused : tuple of (str, str)
    states : tuple of PoseState
        The held-out poses before and after.
    left_out : tuple of str
        Sensors that have too few poses at times with a reference.
    knows_levers : bool
        Whether the motion determines enough of a lever arm to look for effects of place.
    """

    session: PoseSession
    fit: PoseFit
    records: tuple[EffectRecord, ...]
    registered: HeldOutErrors
    before: HeldOutErrors
    after: HeldOutErrors
    floor_m: float
    unexplained: float
    depends_on: tuple[str, ...]
    refused: tuple[tuple[str, str], ...]
    states: tuple[PoseState, PoseState]
    left_out: tuple[str, ...]
    knows_levers: bool


def diagnose_poses(
    session: PoseSession, progress: Callable[[str], None] | None = None
) -> PoseDiagnosis:
    """Find what a tracker of poses lacks on a session.

    Raises
    ------
    DiagnosisError
        When there are too few poses with a reference.
    PlausibilityError
        When tracked and optical poses fit in no reading.
    """
    say = progress or (lambda text: None)
    say('conventions')
    session, convention, exchanged = _as_meant(session)
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
    if not search.knows_levers and _leaves_more(search.fit.state):
        alone_fit = fit_poses(search.fit.state.problem, frame_terms(search.fit.terms))
        search = replace(search, fit=alone_fit, evidence=(None,) * len(alone_fit.terms))
    search = _confirmed(search, problem, test)
    found = search.fit
    whole = _whole(problem, found)
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
    significant = errors.position_m > max(ABOVE_FLOOR * floor, LEAST_TOLD_M)
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
        left_out=_left_out(session, problem),
        knows_levers=search.knows_levers,
    )


def _as_meant(
    session: PoseSession,
) -> tuple[PoseSession, EffectRecord | None, list[EffectRecord]]:
    """The session as it is meant, its convention, and sensors that were exchanged for half of
    it."""
    try:
        return *read_rightly(session), []
    except PlausibilityError:
        session, exchanged = untangled(session)
        if not exchanged:
            raise
        return *read_rightly(session), exchanged


def _left_out(session: PoseSession, problem: PoseProblem) -> tuple[str, ...]:
    others = [name for name, p in session.sensors.items() if p is not most_poses(session)]
    return tuple(name for name in others if name not in problem.setting.sensors)


def _leaves_more(state: PoseState) -> bool:
    """Whether more is left than jitter, so that a clock may stand for what else there is."""
    return state.rms()[0] > ABOVE_FLOOR * floor_of(state)


def _confirmed(search: PoseSearch, problem: PoseProblem, test: NDArray[np.int64]) -> PoseSearch:
    """The search without effects of place that positions do not confirm."""
    fit = search.fit
    for index, term in enumerate(fit.terms):
        if not term.effect.blocks_in_space:
            continue
        rest = fit_poses(fit.state.problem, [t for t in fit.terms if t is not term])
        noisy = replace(problem, noise=fit.state.problem.noise)
        why = unconfirmed(rest, fit, term, judged(noisy.in_blocks(test), fit))
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


def _whole(problem: PoseProblem, found: PoseFit) -> PoseFit:
    """The terms fitted to all poses, time constants of filters too."""
    every = judged(replace(problem, noise=found.state.problem.noise), found)
    return with_time_constants(fit_poses(every, found.terms))


def _sensings(state: PoseState, out: tuple[NDArray[np.bool_], ...]) -> list[Sensing]:
    found = []
    for part, mask in zip(state.parts, out, strict=True):
        noise, cost = noise_of(part)
        gain = noise_of(part, with_stamps=False)[1] - cost
        found.append(Sensing(part.view, part.residual, part.used, mask, noise.position_m,
                             noise.orientation_rad, noise.stamp_s, gain))  # fmt: skip
    return found


def _residuals(session: PoseSession, problem: PoseProblem, whole: PoseFit) -> PoseResiduals:
    every = replace(problem, noise=whole.state.problem.noise)
    out = unexplained_poses(replace(whole, state=every.state(whole.terms)))
    # What stands out of this fit, and not of the one before it: every pose is used or out.
    weight = tuple(np.where(mask, 0.0, 1.0) for mask in out)
    sensings = tuple(_sensings(replace(every, weight=weight).state(whole.terms), out))
    return PoseResiduals(session, problem.setting, sensings)
