"""Diagnoses the last seconds of running trackers of poses: the effects, and what has changed.

A diagnosis of a recording takes the two frames as they are. Live they are known from earlier, so
that a camera that was pushed, or a sensor that came loose, is recognised by comparison.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.apps.poses.diagnosis import PoseDiagnosis, diagnose_poses
from anser_ros.apps.poses.effect import PoseTerm, Role, effect_of_record, pose_effects
from anser_ros.apps.poses.problem import PoseProblem, PoseState
from anser_ros.apps.poses.sequence import REFERENCE, PoseSession
from anser_ros.apps.poses.start import pose_problem
from anser_ros.diagnosis.engine import block_sums
from anser_ros.field.model import EffectRecord

FEWEST_S = 4.0
"""Time, s, that must be left before a stream froze for a diagnosis of the rest."""
CHANGED, CHANGED_M = 2.5, 1.5e-3
"""Factor of the median misfit over the one that was there when the frames were learnt, and its
growth (m), from which something has changed."""
EXPLAINED = 0.4
"""Share of the misfit that may be left by fitting one frame again, if that one has changed."""
FRAME_STEPS = 12  # Gauss-Newton steps for one frame; a turn of 30 deg takes six
FEWEST_POSES_OF_CHANGE = 20  # poses of the later half of a window by which a change is judged


@dataclass(frozen=True)
class PoseSighting:
    """Holds what one look at the last seconds found."""

    # What is wrong; empty when all is well or nothing that is known explains it.
    findings: tuple[EffectRecord, ...]
    poses: int  # tracked poses that were looked at
    # Held-out error with hand-eye alone and with the findings, and what jitter makes; NaN where
    # the poses were judged by the frames of earlier.
    before_m: float = float('nan')
    after_m: float = float('nan')
    jitter_m: float = float('nan')
    # Median distance from where the frames of earlier have the poses; NaN before there are any.
    misfit_m: float = float('nan')
    unexplained: float = 0.0  # share of the squared error above the jitter that nothing explains
    depends_on: tuple[str, ...] = ()  # what that depends on
    remark: str = ''  # why nothing is named although something is there

    @property
    def is_clear(self) -> bool:
        """Return whether there is nothing to be said."""
        return not self.findings and not self.remark


@dataclass(frozen=True)
class _Known:
    """The frames and effects of the first look that determined them all."""

    terms: tuple[PoseTerm, ...]
    misfit: dict[str, float]
    jitter_m: float


class PoseWatch:
    """Looks at one window after the other, and remembers the frames it learnt first.

    ``searches``: how often effects were searched for.
    """

    def __init__(self) -> None:
        self._known: _Known | None = None
        self.searches = 0

    def look(self, session: PoseSession) -> PoseSighting:
        """Look at a window whose stamps count from its own beginning.

        Raises `DiagnosisError` when there are too few poses to say anything.
        Raises `PlausibilityError` when tracked and optical poses fit in no reading.
        """
        poses = sum(one.size for one in session.sensors.values())
        frozen, since = frozen_streams(session)
        if frozen:
            start = min(float(p.time[0]) for p in session.streams.values() if p.size)
            if since - start < FEWEST_S:
                return PoseSighting(frozen, poses)
            session = _until(session, since)
        misfit, changed, remark = self._changes(session)
        if changed or remark:
            return PoseSighting((*frozen, *changed), poses, misfit_m=misfit, remark=remark)
        self.searches += 1
        found = diagnose_poses(session)
        named = [r for r in found.records if effect_of_record(r).role is not Role.MOUNT]
        named += self._more_jitter(found, named)
        if self._known is None and not frozen:
            self._known = _learnt(session, found)
        # Noise that is not quite alike among neighbours is no reason for a warning of its own.
        depends = found.depends_on if not named else ()
        words = f'something depends on {", ".join(depends)}' if depends else ''
        return PoseSighting(
            (*frozen, *named), poses, found.before.position_m, found.after.position_m,
            found.floor_m, misfit, found.unexplained, found.depends_on, words,
        )  # fmt: skip

    def _changes(self, session: PoseSession) -> tuple[float, tuple[EffectRecord, ...], str]:
        """Median misfit by the known frames (m), the frame that has changed, or why none."""
        known = self._known
        if known is None or session.reference is None:
            return float('nan'), (), ''
        # A change in the window's first half has left the later one behind.
        problem = pose_problem(session)
        ends = np.concatenate([p.time[[0, -1]] for p in problem.sensors])
        middle = 0.5 * (ends.min() + ends.max())
        problem = problem.rows([p.time > middle for p in problem.sensors])
        present = {None, *(poses.name for poses in problem.sensors)}
        terms = [t for t in known.terms if t.sensor in present]
        state = problem.state(terms)
        misfit = _misfits(state)
        if not misfit or not set(misfit) <= set(known.misfit):
            return float('nan'), (), ''
        off = [
            name for name, size in misfit.items()
            if size > max(CHANGED * known.misfit[name], known.misfit[name] + CHANGED_M)
        ]  # fmt: skip
        worst = max(misfit.values())
        if not off:
            return worst, (), ''
        trials = []
        for index, term in enumerate(terms):
            # The reference's frame is every sensor's, a mount is its own.
            effect = term.effect
            if effect.role.is_frame and off == [s for s in misfit if term.acts_on(s)]:
                moved = _fitted_alone(problem, terms, index)
                left = max(_misfits(problem.state(moved)).values())
                trials.append((left, index, moved))
        left, index, moved = min(trials, key=lambda t: t[0], default=(np.inf, 0, terms))
        limit = max(EXPLAINED * worst, CHANGED * max(known.misfit.values()))
        if left > limit:
            return worst, (), (
                f'{", ".join(off)}: poses are {1e3 * worst:.1f} mm from where the frames found '
                    'earlier place them, and no single frame explains it yet'
            )  # fmt: skip
        return worst, (_change(terms[index], moved[index], state, worst, left),), ''

    def _more_jitter(
        self, found: PoseDiagnosis, named: Sequence[EffectRecord]
    ) -> Sequence[EffectRecord]:
        """More jitter than at first, unless something that is named makes it."""
        if self._known is None or any(effect_of_record(r).makes_jitter for r in named):
            return ()
        factor = found.floor_m / max(self._known.jitter_m, 1e-9)
        return [r for effect in pose_effects().values() for r in effect.more_jitter(factor)]


def frozen_streams(session: PoseSession) -> tuple[tuple[EffectRecord, ...], float]:
    """Return streams that have stopped while another goes on, and since when (s)."""
    found = tuple(r for effect in pose_effects().values() for r in effect.frozen(session))
    return found, min((float(r.parameters['since_s']) for r in found), default=np.inf)


def _until(session: PoseSession, end: float) -> PoseSession:
    streams = {name: poses.rows(poses.time < end) for name, poses in session.streams.items()}
    reference = streams.pop(REFERENCE, None)
    return replace(session, sensors=streams, reference=reference)


def _misfits(state: PoseState) -> dict[str, float]:
    """Median distance (m) of each sensor that has poses enough."""
    found = {}
    for part in state.parts:
        far = np.linalg.norm(part.residual[part.used, :3], axis=1)
        if far.size >= FEWEST_POSES_OF_CHANGE:
            found[part.view.sensor] = float(np.median(far))
    return found


def _learnt(session: PoseSession, found: PoseDiagnosis) -> _Known | None:
    """What later windows are judged by; None where the motion does not determine the frames."""
    eyes = [r for r in found.records if effect_of_record(r).role is Role.MOUNT]
    if session.reference is None or not all(e.evidence.get('observable') for e in eyes):
        return None
    misfit = _misfits(pose_problem(session).state(found.fit.terms))
    return _Known(found.fit.terms, misfit, found.floor_m) if misfit else None


def _fitted_alone(problem: PoseProblem, terms: Sequence[PoseTerm], index: int) -> list[PoseTerm]:
    """The terms with one of them fitted to the poses, all others as they are."""
    trial = list(terms)
    prior = trial[index].effect.prior(trial[index])
    for _ in range(FRAME_STEPS):
        state = problem.state(trial)
        sums = block_sums(state.parts, state.design(trial[index]), state.numbers)
        moved = trial[index].with_theta(trial[index].theta + sums.step(prior, 0.0))
        trial[index] = moved.effect.bounded(moved)
    return trial


def _change(
    before: PoseTerm, after: PoseTerm, state: PoseState, worst: float, left: float
) -> EffectRecord:
    """The change of a frame as an effect, with the misfits (m) without and with it."""
    middle = np.concatenate([p.view.optical[p.used] for p in state.parts]).mean(axis=0)
    record = before.effect.moved(before, after, middle)
    misfits = {'misfit_before_m': worst, 'misfit_after_m': left}
    return replace(record, evidence={**misfits, **record.evidence})
