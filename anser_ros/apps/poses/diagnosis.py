"""Diagnoses a session of poses: convention, hand-eye, search, and what held-out poses say.

The stages are those of a diagnosis of fluxes: read and set up, search on four fifths of the blocks
of time, judge on the fifth that took no part; then the parameters are fitted to all poses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses import start
from anser_ros.apps.poses.convention import read_rightly
from anser_ros.apps.poses.effect import PoseTerm, PoseView, Role, pose_effects
from anser_ros.apps.poses.effects.episodes import in_episode, is_passed
from anser_ros.apps.poses.fit import (
    PoseFit,
    fit_poses,
    knows_levers,
    most_poses,
    noise_of,
    with_time_constants,
)
from anser_ros.apps.poses.hand_eye import records_of
from anser_ros.apps.poses.problem import (
    PosePart,
    PoseProblem,
    PoseResiduals,
    PoseState,
    Sensing,
    floor_of,
)
from anser_ros.apps.poses.search import (
    LEAST_MAP_M,
    PoseSearch,
    frame_terms,
    judged,
    search_effects,
    with_noise,
)
from anser_ros.apps.poses.sequence import REFERENCE, PoseSession
from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.diagnosis.problem import TEST_EVERY
from anser_ros.errors import PlausibilityError
from anser_ros.field.model import EffectRecord

FEWEST_RECORDINGS = 8  # at rest, from which each is judged by others: fewer leave frames open


@dataclass(frozen=True)
class HeldOutErrors:
    """Holds held-out errors of all sensors, and by sensor: distance (m) and angle (rad), rms."""

    position_m: float
    orientation_rad: float
    by_sensor: dict[str, tuple[float, float]]


def errors_of(state: PoseState) -> HeldOutErrors:
    """Return the errors of a state, rms."""
    every = state.rms()
    return HeldOutErrors(*every, {p.view.sensor: state.rms(p.view.sensor) for p in state.parts})


def held_out(
    problem: PoseProblem, found: PoseFit, test: Integers
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

        def put(rows: Sequence[Any], keys: Sequence[str], order: Any = order) -> dict[str, Any]:
            return {k: np.concatenate([getattr(row, k) for row in rows])[order] for k in keys}

        one_each = ('sensor', 'frame', 'lever')
        keys = [field.name for field in fields(PoseView) if field.name not in one_each]
        view = replace(same[0].view, **put([p.view for p in same], keys))
        values = put(same, ('residual', 'weight', 'blocks', 'places'))
        parts.append(replace(same[0], view=view, **values))
    return replace(states[0], parts=tuple(parts))


def _registered(frames: PoseFit, unseen: PoseProblem) -> list[Array]:
    """Squared distances that registering the places of each sensor alone leaves."""
    squares = []
    for fitted, part in zip(frames.state.parts, unseen.state(frames.terms).parts, strict=True):
        optical, place = fitted.view.optical[fitted.used], fitted.view.measured[fitted.used]
        off = part.view.measured[part.used]
        if len(place):
            rotation = start.frames_from_places(place, optical)
            shift = np.mean(place - optical @ rotation.T, axis=0)
            off = off - part.view.optical[part.used] @ rotation.T - shift
        squares.append(np.sum(off**2, axis=1))
    return squares


GROUPS = 6  # groups of neighbours by which a dependence is looked for
LEAST_OF_MEANS = 0.1
"""Share (0 to 1) of the squared residual that groups' means must explain beyond chance to be
reported; without it the error would be 5 % less."""
FEWEST_POSES = 30  # poses of a sensor by which a dependence is judged
TWICE = 1 / 3
"""Share by which halves of poses differ, of their sum, if one has twice the squared error of the
other; a tracker's error grows a little with the distance."""


def depends_on(state: PoseState) -> tuple[str, ...]:
    """Return names of what the residual depends on, the strongest first.

    The distance is that from the tracker's origin, which is at its field generator.
    """
    shares = {}
    parts = [part for part in state.parts if np.count_nonzero(part.used) > FEWEST_POSES]
    for name in ('time', 'position', 'orientation', 'speed', 'distance') if parts else ():
        shares[name] = float(np.median([_share(part, name) for part in parts]))
    if shares.get('distance', 0.0) < TWICE:
        shares.pop('distance', None)
    ordered = sorted(shares, key=lambda name: -shares[name])
    return tuple(name for name in ordered if shares[name] > LEAST_OF_MEANS)


def _share(part: PosePart, name: str) -> float:
    """Share of the squared residual that means of groups explain, less what chance gives."""
    used = part.used
    residual = part.residual[used, :3]
    if name in ('speed', 'distance'):
        values = part.view.velocity[:, :3] if name == 'speed' else part.view.measured
        along = np.linalg.norm(values[used], axis=1)
        size = np.sum(residual**2, axis=1)
        upper = along > np.median(along)
        if not upper.any():  # all is at rest
            return 0.0
        low, high = float(size[~upper].mean()), float(size[upper].mean())
        return max((high - low) / max(high + low, 1e-18), 0.0)
    groups = _groups(part, used, name)
    numbers, explained = np.unique(groups), 0.0
    for group in numbers:
        rows = residual[groups == group]
        explained += len(rows) * float(np.sum(rows.mean(axis=0) ** 2))
    total = float(np.sum(residual**2))
    return explained / max(total, 1e-18) - len(numbers) / max(len(residual), 1)


def _groups(part: PosePart, used: Booleans, name: str) -> Integers:
    if name == 'time':
        time = part.view.time[used]
        return np.asarray(np.argsort(np.argsort(time)) * GROUPS**2 // time.size, dtype=np.int64)
    if name == 'position':
        values = part.view.measured[used]
    else:
        turns = Rotation.from_matrix(part.view.measured_rotation[used])
        values = (turns.mean().inv() * turns).as_rotvec()
    code = np.zeros(len(values), dtype=np.int64)
    for axis in range(3):
        rank = np.argsort(np.argsort(values[:, axis]))
        code = 4 * code + rank * 4 // len(values)
    return code


ABOVE_FLOOR = 1.3
"""Factor of the held-out error over the jitter from which something stays unexplained."""

LEAST_REPORTED_M = 0.3e-3
"""Held-out error, m, below which nothing is said to be unexplained: no tracker promises less. Of
one place at rest, which jitters by micrometres, something always is."""


BASELINE_BEFORE_S = 10.0  # s by which a baseline ends before the session: a pause of all streams


@dataclass(frozen=True)
class PoseDiagnosis:
    """Holds what a session of poses was found to contain."""

    session: PoseSession  # as it is meant (units, order of quaternions)
    fit: PoseFit  # the two frames and all effects, on all poses
    records: tuple[EffectRecord, ...]  # the effects that are named
    registered: HeldOutErrors  # held out, with the registration alone
    outside_m: float  # held-out error with the effects, outside the episodes that are named, m
    floor_m: float  # what jitter alone would leave of it, m
    unexplained: float  # share of its square above the jitter that stays
    depends_on: tuple[str, ...]
    refused: tuple[tuple[str, str], ...]
    states: tuple[PoseState, PoseState]  # the held-out poses with hand-eye, and with the effects
    left_out: tuple[str, ...]  # sensors that have too few poses at times with a reference
    knows_levers: bool  # whether the motion determines enough to look for effects of place

    @cached_property
    def before(self) -> HeldOutErrors:
        """Return the held-out errors with hand-eye alone."""
        return errors_of(self.states[0])

    @cached_property
    def after(self) -> HeldOutErrors:
        """Return the held-out errors with the effects."""
        return errors_of(self.states[1])


def diagnose_poses(
    session: PoseSession, progress: Callable[[str], None] | None = None,
    baseline: PoseSession | None = None, is_searched: bool = True,
) -> PoseDiagnosis:  # fmt: skip
    """Find what a tracker of poses lacks on a session.

    ``baseline``: of the same trackers, body and clocks, without metal: it takes part in all but
    the held-out errors; ``is_searched``: whether effects are looked for, beside the frames.
    Raises `DiagnosisError` when there are too few poses with a reference.
    Raises `PlausibilityError` when tracked and optical poses fit in no reading.
    """
    say = progress or (lambda text: None)
    begin = min((float(p.time[0]) for p in session.streams.values() if p.size), default=0.0)
    session = session if baseline is None else _behind(baseline, session, begin)
    say('conventions')
    exchanged: list[EffectRecord] = []
    try:
        session, convention = read_rightly(session)
    except PlausibilityError:
        # Nothing fits all of a session whose sensors were exchanged for half of it.
        session, exchanged = start.untangled(session)
        if not exchanged:
            raise
        session, convention = read_rightly(session)
    problem = start.pose_problem(session)
    train, test = start.train_blocks(problem)
    say('hand-eye')
    alone = session.reference is None
    training = problem.in_blocks(train)
    first = start.first_fit(training, start.coarse_clock(training), alone)
    swaps = start.swapped_spans(problem, first)
    session, swapped = start.put_back(session, swaps)
    if swaps:
        problem = start.pose_problem(session)
        training = problem.in_blocks(train)
        first = start.first_fit(training, start.coarse_clock(training), alone)
    search = _outside_episodes(search_effects(first, session, say, is_searched), session, say)
    say('held out')
    state = search.fit.state
    # A clock may stand for what else there is besides jitter.
    if is_searched and not search.knows_levers and state.rms()[0] > ABOVE_FLOOR * floor_of(state):
        search = _alone(search, 'leaves more than jitter, and no lever arm is known')
    search = _confirmed(search, problem, test)
    own = problem.rows([poses.time >= begin for poses in problem.sensors])
    before, after, registered = held_out(own, search.fit, test)
    if after.rms()[0] > before.rms()[0] and any(search.evidence):
        search = _alone(search, 'held-out poses are worse with all that is found')
        before, after, registered = held_out(own, search.fit, test)
    whole = _on_all(session, problem, search.fit, is_searched and search.knows_levers)
    residuals = _residuals(session, problem, whole)
    records = records_of(whole, search.evidence, session)
    most = most_poses(session)
    is_known = search.knows_levers and knows_levers(whole, most)
    for effect in pose_effects().values() if is_searched else ():
        seen = effect.observed(residuals) if is_known or not effect.needs_levers else ()
        records += [replace(r, evidence={**effect.words, **r.evidence}) for r in seen]
    records += [*exchanged, *swapped, *([] if convention is None else [convention])]
    loud, quiet = before, after
    if is_searched and is_known:
        loud, quiet = (_outside(state, residuals) for state in (before, after))
    floor, (error, _) = floor_of(quiet), quiet.rms()
    excess = max(error**2 - floor**2, 0.0)
    possible = max(loud.rms()[0] ** 2 - floor**2, excess, 1e-18)
    significant = error > max(ABOVE_FLOOR * floor, LEAST_REPORTED_M)
    return PoseDiagnosis(
        session=session,
        fit=whole,
        records=tuple(records),
        registered=registered,
        outside_m=error,
        floor_m=floor,
        unexplained=excess / possible if significant else 0.0,
        depends_on=(depends_on(quiet) or depends_on(whole.state)) if significant else (),
        refused=search.refused,
        states=(before, after),
        left_out=tuple(
            name
            for name, poses in session.sensors.items()
            if poses is not most and name not in problem.setting.sensors
        ),
        knows_levers=search.knows_levers,
    )


def _on_all(
    session: PoseSession, problem: PoseProblem, found: PoseFit, has_episodes: bool
) -> PoseFit:
    """What was found, fitted to all poses; outside episodes if these tell the lever arms."""
    known = judged(problem, found)
    whole = with_time_constants(fit_poses(known, found.terms))
    if not has_episodes:
        return whole
    outside = _outside(known.state(found.terms), _residuals(session, problem, whole))
    quiet = with_time_constants(fit_poses(outside.problem, found.terms))
    return quiet if knows_levers(quiet, most_poses(session)) else whole


def _outside(state: PoseState, residuals: PoseResiduals) -> PoseState:
    """A state without the poses of episodes, which have their reason."""
    inside = {s.view.sensor: s.view.time[in_episode(s, residuals)] for s in residuals.sensors}
    parts = [
        replace(p, weight=np.where(np.isin(p.view.time, inside[p.view.sensor]), 0.0, p.weight))
        for p in state.parts
    ]
    problem = replace(state.problem, weight=tuple(p.weight for p in parts))
    return replace(state, problem=problem, parts=tuple(parts))


def _behind(baseline: PoseSession, session: PoseSession, begin: float) -> PoseSession:
    """A session from a time on, s, with the same streams of another one before it."""
    end = max(float(p.time[-1]) for p in baseline.streams.values() if p.size)
    streams = {}
    for name, poses in session.streams.items():
        streams[name] = poses
        if name in baseline.streams:
            first = baseline.streams[name]
            earlier = replace(first, time=first.time + begin - end - BASELINE_BEFORE_S)
            keys = ('time', 'position', 'quaternion')
            rows: dict[str, Any] = {
                k: np.concatenate([getattr(p, k) for p in (earlier, poses)]) for k in keys
            }
            streams[name] = replace(poses, **rows)
    reference = streams.pop(REFERENCE, None)
    return replace(session, sensors=streams, reference=reference)


def _outside_episodes(
    search: PoseSearch, session: PoseSession, say: Callable[[str], None]
) -> PoseSearch:
    """The search, again without the poses of episodes, which frames and maps may follow."""
    problem = search.fit.state.problem
    rest = [t for t in search.fit.terms if t.role is not Role.MAP]
    if not search.knows_levers:
        return search
    plain = search.fit
    if len(rest) < len(plain.terms):
        plain = with_noise(fit_poses(problem, rest))
    residuals = _residuals(session, problem, plain)
    inside = [is_passed(one, residuals) for one in residuals.sensors]
    if not any(mask.any() for mask in inside):
        return search
    cut = plain.state.problem.rows([~mask for mask in inside])
    again = search_effects(fit_poses(cut, frame_terms(rest)), session, say)
    return again if again.knows_levers else search


def _alone(search: PoseSearch, why: str) -> PoseSearch:
    """The search with the frames alone."""
    problem, terms = search.fit.state.problem, frame_terms(search.fit.terms)
    return _less(search, with_noise(fit_poses(problem, terms), False), why)


def _less(search: PoseSearch, fit: PoseFit, why: str) -> PoseSearch:
    """The search with a fit that lacks some of its effects, and why."""
    terms, left = search.fit.terms, {term.label for term in fit.terms}
    refused = [(term.label, why) for term in terms if term.label not in left]
    evidence = [e for e, t in zip(search.evidence, terms, strict=True) if t.label in left]
    return replace(search, fit=fit, evidence=tuple(evidence), refused=(*search.refused, *refused))


def _confirmed(search: PoseSearch, problem: PoseProblem, test: Integers) -> PoseSearch:
    """The search without effects that positions do not confirm."""
    fit = search.fit
    for term in (t for t in fit.terms if not t.role.is_frame):
        rest = fit_poses(fit.state.problem, [t for t in fit.terms if t is not term])
        why = unconfirmed(rest, fit, term, judged(problem.in_blocks(test), fit))
        if why:
            return _confirmed(_less(search, rest, why), problem, test)
    return search


def unconfirmed(rest: PoseFit, fit: PoseFit, term: PoseTerm, unseen: PoseProblem) -> str:
    """Return why an effect is not believed beside the rest; empty where it is.

    ``rest`` is the fit without it, and ``unseen`` the held-out poses. A map that moves poses but
    takes nothing off their errors makes up for frames that it has moved; on a path that comes
    again, a tracker's own errors look like a small offset, lag or scale.
    """
    taken = rest.state.rms(term.sensor)[0] ** 2 - fit.state.rms(term.sensor)[0] ** 2
    least = LEAST_MAP_M if term.role is Role.MAP else LEAST_REPORTED_M
    if taken < least**2:
        return f'takes less than {1e3 * least:g} mm off the errors of positions'
    before, after = (unseen.state(one.terms).rms(term.sensor)[0] for one in (rest, fit))
    return 'held-out poses are worse with it' if before < after else ''


def _residuals(session: PoseSession, problem: PoseProblem, whole: PoseFit) -> PoseResiduals:
    """What the last fit leaves; what stands out of it, and not of the one before, is out."""
    known, sensings = judged(problem, whole), []
    for part, weight in zip(known.state(whole.terms).parts, known.weight, strict=True):
        noise, cost = noise_of(part)
        gain = noise_of(part, with_stamps=False)[1] - cost
        sensings.append(
            Sensing(part.view, part.residual, part.weight, noise, part.blocks, part.places,
                    weight == 0.0, gain)
        )  # fmt: skip
    return PoseResiduals(session, problem.setting, tuple(sensings))
