"""Diagnoses a session of poses: convention, hand-eye, search, and what held-out poses say.

The stages are those of a diagnosis of fluxes: read and set up, search on four fifths of the blocks
of time, judge on the fifth that took no part; then the parameters are fitted to all poses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.diagnosis.prepare import TEST_EVERY
from anser_ros.effects.term import Term
from anser_ros.errors import PlausibilityError
from anser_ros.field.model import EffectRecord
from anser_ros.poses.clock_records import one_clock
from anser_ros.poses.convention import read_rightly
from anser_ros.poses.effect import (
    Frames,
    PoseResiduals,
    PoseView,
    Role,
    Sensing,
    effect_of,
    frames_of,
    is_of,
)
from anser_ros.poses.fit import (
    PoseFit,
    fit_poses,
    noise_of,
    unexplained_poses,
    with_time_constants,
)
from anser_ros.poses.jitter import jitter
from anser_ros.poses.lever_arms import (
    LEAST_KNOWN_M,
    LEAST_KNOWN_RAD,
    is_lever_determined,
    knows_levers,
    most_poses,
    turn_jitter,
)
from anser_ros.poses.problem import PosePart, PoseProblem, PoseState
from anser_ros.poses.registry import effect_with, pose_effects
from anser_ros.poses.search import PoseEvidence, PoseSearch, frame_terms, search_effects
from anser_ros.poses.sequence import PoseSession
from anser_ros.poses.start import (
    coarse_offset,
    first_fit,
    frames_from_places,
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
FEWEST_RECORDINGS = 8
"""Recordings at rest from which each is judged by a fit of others: of fewer the rest does not
determine all frames, and errs by what that makes. Fewer report that for a tracker's error; more
report what two or three places happen to be."""


@dataclass(frozen=True)
class HeldOutErrors:
    """Holds held-out errors of all sensors, and by sensor: distance (m) and angle (rad), rms."""

    position_m: float
    orientation_rad: float
    by_sensor: dict[str, tuple[float, float]]


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
    before, after, registered = _held_out(problem, found, test)
    floor = _floor(after)
    residuals = _residuals(session, problem, whole)
    records = _records(whole, search.evidence, session)
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
    errors = _errors(after)
    excess = max(errors.position_m**2 - floor**2, 0.0)
    possible = max(_errors(before).position_m ** 2 - floor**2, excess, 1e-18)
    significant = errors.position_m > max(ABOVE_FLOOR * floor, LEAST_TOLD_M)
    return PoseDiagnosis(
        session=session,
        fit=whole,
        records=tuple(records),
        registered=registered,
        before=_errors(before),
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
    return state.rms()[0] > ABOVE_FLOOR * _floor(state)


def _confirmed(search: PoseSearch, problem: PoseProblem, test: NDArray[np.int64]) -> PoseSearch:
    """The search without effects of place that make the held-out poses worse.

    Poses near each other err alike, and a few places may ask for what no others confirm.
    """
    for index, term in enumerate(search.fit.terms):
        if not effect_of(term).blocks_in_space:
            continue
        fit = search.fit
        noisy = replace(problem, noise=fit.state.problem.noise)
        unseen = _judged(noisy.in_blocks(test), fit)
        rest = fit_poses(fit.state.problem, [t for t in fit.terms if t is not term])
        if _square(unseen.state(rest.terms), term) < _square(unseen.state(fit.terms), term):
            evidence = tuple(e for k, e in enumerate(search.evidence) if k != index)
            why = (term.label, 'held-out poses are worse with it')
            left = replace(search, fit=rest, evidence=evidence, refused=(*search.refused, why))
            return _confirmed(left, problem, test)
    return search


def _square(state: PoseState, term: Term) -> float:
    """Squared errors of the positions, m^2, of the sensors that a term is about."""
    parts = [p for p in state.parts if effect_of(term).acts_on(term, p.view.sensor)]
    return float(sum(np.sum(p.residual[p.used, :3] ** 2) for p in parts))


def _held_out(
    problem: PoseProblem, found: PoseFit, test: NDArray[np.int64]
) -> tuple[PoseState, PoseState, HeldOutErrors]:
    """Poses that took no part in a fit: before, after, and what registration alone leaves.

    Recordings at rest are few, and a fifth of them says little: each is judged by a fit of others.
    """
    noisy, folds = replace(problem, noise=found.state.problem.noise), [(found, test)]
    if problem.path.is_at_rest and np.unique(problem.blocks[0]).size >= FEWEST_RECORDINGS:
        every, known = np.unique(np.concatenate(problem.blocks)), _judged(noisy, found)
        parts = [every[k::TEST_EVERY] for k in range(min(TEST_EVERY, every.size))]
        folds = [
            (fit_poses(known.in_blocks(np.setdiff1d(every, part)), found.terms), part)
            for part in parts
        ]
    before, after, squares = [], [], []
    for fit, part in folds:
        frames = fit_poses(_without_stamps(fit.state.problem), frame_terms(fit.terms))
        unseen = _judged(noisy.in_blocks(part), fit)
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


def _without_stamps(problem: PoseProblem) -> PoseProblem:
    return replace(problem, noise=tuple(replace(n, stamp_s=0.0) for n in problem.noise))


def _judged(problem: PoseProblem, fit: PoseFit) -> PoseProblem:
    """A problem without the poses that stand out from a fit."""
    every = replace(problem, weight=tuple(np.ones(s.size) for s in problem.sensors))
    out = unexplained_poses(replace(fit, state=every.state(fit.terms)))
    return replace(problem, weight=tuple(np.where(mask, 0.0, 1.0) for mask in out))


def _whole(problem: PoseProblem, found: PoseFit) -> PoseFit:
    """The terms fitted to all poses, time constants of filters too."""
    every = _judged(replace(problem, noise=found.state.problem.noise), found)
    return with_time_constants(fit_poses(every, found.terms))


def _errors(state: PoseState) -> HeldOutErrors:
    every = state.rms()
    return HeldOutErrors(*every, {p.view.sensor: state.rms(p.view.sensor) for p in state.parts})


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
    return PoseResiduals(session, problem.setting, sensings, problem.blocks)


def _floor(state: PoseState) -> float:
    """Distance that jitter alone makes, m: from differences between neighbours."""
    squares = []
    for part in state.parts:
        is_resting = not part.view.velocity.any()  # each recording has an error of its own
        groups = np.unique(part.blocks) if is_resting else (None,)
        rows = [part.used if k is None else part.used & (part.blocks == k) for k in groups]
        sensings = [Sensing(part.view, part.residual, r, ~r, 0.0, 0.0, 0.0, 0.0) for r in rows]
        square = np.concatenate([jitter(sensing)[0] for sensing in sensings])
        noise = part.noise
        along = noise.stamp_s * np.linalg.norm(part.view.velocity[part.used, :3], axis=1)
        if square.size and along.size:
            squares.append(3 * float(np.mean(square)) + float(np.mean(along**2)))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def _records(
    fit: PoseFit, evidence: tuple[PoseEvidence | None, ...], session: PoseSession
) -> list[EffectRecord]:
    """Hand-eye of each sensor, and the effects that were fitted."""
    covariance = fit.covariance()
    covariances = [fit.covariance_of(i, covariance) for i in range(len(fit.terms))]
    base = next((i for i, t in enumerate(fit.terms) if is_of(t, Role.REGISTRATION)), None)
    shaking = turn_jitter(most_poses(session))
    views = [part.view for part in fit.state.parts]
    records = []
    for i, term in enumerate(fit.terms):
        if is_of(term, Role.MOUNT):
            name = str(effect_of(term).sensor_of(term))
            spread = None if base is None else covariances[base]
            part = next(p for p in fit.state.parts if p.view.sensor == name)
            is_determined = is_lever_determined(part, shaking)
            frames = frames_of(fit.terms, name)
            records.append(hand_eye_record(name, frames, covariances[i], spread, is_determined))
    for term, one, spread in zip(fit.terms, evidence, covariances, strict=True):
        if one is None:
            continue
        record = term.effect.record(term, spread)
        record = effect_of(term).seen_at(record, term, spread, views)
        words = {
            'summary': term.effect.summary, 'advice': effect_of(term).advice,
            'remedy': term.effect.remedy.value,
            'parameters_spent': int(term.theta.size), 'held_out_gain': one.gain,
            'held_out_share': one.share,
            'position_rmse_without_m': one.position_rmse_without_m,
            'position_rmse_with_m': one.position_rmse_with_m,
        }  # fmt: skip
        records.append(replace(record, evidence=words))
    return one_clock(records, fit.state.problem.setting.duration)


def hand_eye_record(
    sensor: str,
    frames: Frames,
    spread: Array,
    frame_spread: Array | None,
    is_determined: NDArray[np.bool_],
) -> EffectRecord:
    """Return optical frame, lever arm and mount of a sensor; None where the motion does not
    determine them, and for the optical frame where it was not fitted.
    """

    def degrees(matrix: Array) -> list[float]:
        turn = np.rad2deg(Rotation.from_matrix(matrix).as_rotvec())
        return [float(v) for v in turn]

    sigma = np.sqrt(np.maximum(np.diag(spread), 0.0))
    lever = [
        float(v) if s < LEAST_KNOWN_M and is_known else None
        for v, s, is_known in zip(frames.lever, sigma[:3], is_determined, strict=True)
    ]
    values: dict[str, object] = {
        'sensor': sensor,
        'lever_arm_m': lever,
        'mount_rotation_deg': degrees(frames.mount),
        'registration_rotation_deg': None,
        'registration_translation_m': None,
    }
    uncertainty: dict[str, object] = {
        'lever_arm_m': sigma[:3].tolist(),
        'mount_rotation_deg': np.rad2deg(sigma[3:]).tolist(),
    }
    if frame_spread is not None:
        frame_sigma = np.sqrt(np.maximum(np.diag(frame_spread), 0.0))
        values['registration_rotation_deg'] = degrees(frames.rotation)
        values['registration_translation_m'] = frames.translation.tolist()
        uncertainty['registration_rotation_deg'] = np.rad2deg(frame_sigma[3:]).tolist()
        uncertainty['registration_translation_m'] = frame_sigma[:3].tolist()
    known = all(v is not None for v in lever) and bool(np.all(sigma[3:] < LEAST_KNOWN_RAD))
    effect = effect_with(Role.MOUNT)
    evidence = {'summary': effect.summary, 'observable': known}
    return EffectRecord(effect.name, values, uncertainty, evidence)
