"""Diagnoses the last seconds lightly: only a change of the residual starts a search.

`SlidingWindow` keeps the last seconds as a session, at which `Watch` looks.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from anser_ros.arrays import ComplexArray, Integers
from anser_ros.diagnosis.diagnose import diagnose
from anser_ros.diagnosis.problem import FEWEST_POSED_FRAMES, Problem, State, evaluate, rms
from anser_ros.diagnosis.search import SearchSettings
from anser_ros.effects.effect import Term
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.pose_states import OK
from anser_ros.sessions.diagnosis import problem_of, spread_of
from anser_ros.sessions.prepared import PreparedSession, correct
from anser_ros.sessions.session import Session, session_of, shifted
from anser_ros.stamps import NANO, Order, order_of
from anser_ros.tracking.estimate import NO_GATE, TrackerSettings
from anser_ros.tracking.tracker import Tracker
from anser_ros.wire.points import FluxPoints
from anser_ros.wire.recorded import Bag, PoseStream, RecordedFluxes, unit_quaternions
from anser_ros.wire.setup import Setup

OPTICAL, RIGID = 'optical poses', 'rigidity of the tools'
LIGHT_SEARCH = SearchSettings(most_effects=1, finalists=4, iterations=6)
"""A search for the strongest effect alone, in seconds; the rest is left to the whole diagnosis."""
FREE_POSE_M, FREE_POSE_RAD = 0.02, 0.1
"""Standard deviations, m and rad per axis, of a pose from the fluxes: it contradicts no effect."""
EXCESS = 1.25
"""Mean square of whitened residuals from which on the model lacks something; noise gives 1."""
SAME = 1.3
"""Factor by which the residual that a finding leaves may grow before it is searched for again."""
LEAST_SPREAD_M, LEAST_TURN_RAD = 0.01, 0.1
"""Least spread of a tool's places, m, and orientations, rad, with which a cause can be found."""


@dataclass(frozen=True)
class Sighting:
    """Holds what a look found by comparing the fluxes with ``truth``.

    The excess is the mean square of the residuals of the tools' frames in units of what is
    expected: 1 when all is well; ``excess_left`` is with the findings, empty also when no effect
    explains it, as ``remark`` says. The residual is in T a phasor component; terms and model are
    the findings', and ``depends_on`` is what the unexplained part depends on.
    """

    truth: str
    frames: int = 0
    findings: tuple[EffectRecord, ...] = ()
    excess: float = 1.0
    excess_left: float = 1.0
    flux_rms_t: float = 0.0
    depends_on: tuple[str, ...] = ()
    remark: str = ''
    terms: tuple[Term, ...] = ()
    model: FieldModel | None = None

    @property
    def is_clear(self) -> bool:
        return self.excess < EXCESS and not self.findings


class Watch:
    """Looks at one window after the other, and remembers what it found.

    It is made of any session of the setup, also an empty one, with the model whose effects are
    corrected; ``searches`` counts how often something new was searched for.
    """

    def __init__(self, prepared: PreparedSession) -> None:
        self._prepared = prepared
        self._last: Sighting | None = None
        self._left = 1.0  # what the last search left
        self.searches = 0

    def look(self, session: Session, first_ns: int) -> Sighting:
        """Look at the last seconds; raises `DiagnosisError` when there are too few frames."""
        seen = self._corrected(session, (session.start_ns - first_ns) * NANO)
        posed = sum(int(tool.has_pose.sum()) for tool in seen.session.tools)
        self._last = self._judged(seen, OPTICAL if posed >= FEWEST_POSED_FRAMES else RIGID)
        return self._last

    def _corrected(self, session: Session, began_s: float) -> PreparedSession:
        """The window as the model's own effects, whose time began earlier, leave it."""
        # The course of a drift that another session took says nothing of this one.
        later = replace(
            self._prepared.with_session(_moved(session, began_s)), recorded_drift=False
        )
        corrected = correct(later)
        return corrected.with_session(_moved(corrected.session, -began_s))

    def _problem(self, seen: PreparedSession, truth: str, by: FieldModel) -> Problem:
        """What is to be diagnosed; where the tools give their own poses, they do so by a model."""
        if truth == OPTICAL:
            return problem_of(seen)
        # The model's own effects are taken off already.
        by = replace(by, effects=by.effects[len(seen.model.effects) :])
        tools = tuple(_posed_by_itself(tool, by) for tool in seen.session.tools)
        spread = spread_of(seen)
        free = {'optical_position_m': FREE_POSE_M, 'optical_rotation_rad': FREE_POSE_RAD}
        spread = replace(spread, accuracy=replace(spread.accuracy, **free))
        return problem_of(seen.with_session(replace(seen.session, tools=tools)), spread)

    def _judged(self, window: PreparedSession, truth: str) -> Sighting:
        problem = self._problem(window, truth, self._prepared.model)
        plain = evaluate(problem, ())
        excess, frames = _excess(plain), sum(tool.time.size for tool in problem.tools)
        seen = Sighting(truth, frames, (), excess, excess, rms(plain))
        if excess < EXCESS:
            return seen
        last = self._last
        if last is not None and last.truth == truth and last.model is not None:
            # Poses by a model that is wrong are off by more than their errors' first order.
            again = problem if truth == OPTICAL else self._problem(window, truth, last.model)
            left = _excess(evaluate(again, last.terms))
            if left < max(EXCESS, SAME * self._left):
                return replace(
                    last, frames=frames, excess=excess, excess_left=left, flux_rms_t=rms(plain)
                )
        if not _moves(problem):
            return replace(seen, remark='the tool moves too little to identify the effect')
        self.searches += 1
        found = diagnose(problem, self._prepared.model, LIGHT_SEARCH)
        left = _excess(evaluate(problem, found.terms))
        if truth == RIGID and found.findings and left >= EXCESS:
            problem = self._problem(window, truth, found.model)
            found = diagnose(problem, self._prepared.model, LIGHT_SEARCH)
            left = _excess(evaluate(problem, found.terms))
        self._left = left
        return replace(
            seen,
            findings=tuple(finding.record for finding in found.findings),
            excess_left=left,
            depends_on=found.depends_on,
            terms=found.terms,
            model=found.model,
        )


def _moved(session: Session, seconds: float) -> Session:
    """The session on a time axis that begins so much earlier."""
    reference = session.reference
    return replace(
        session,
        tools=tuple(shifted(tool, seconds) for tool in session.tools),
        reference=None if reference is None else shifted(reference, seconds),
    )


def _posed_by_itself(tool: Measurements, model: FieldModel) -> Measurements:
    """A rigid tool with the poses that all its coils together give it."""
    tracker = Tracker(model, tool.sensors, TrackerSettings(gate=NO_GATE, adaptive=False))
    count = tool.time.size
    position, rotation = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    has_pose = np.zeros(count, dtype=bool)
    frames = zip(tool.time.tolist(), tool.flux, tool.flags, strict=True)
    for row, (time, flux, flags) in enumerate(frames):
        # Any epoch will do: the frames only have to follow one another.
        stamp_ns = round((time + 1.0) / NANO)
        estimates = tracker.update(stamp_ns, tool.sensors.channel, flux, flags)
        own = next((e for e in estimates if e.name == tool.body and e.state == OK), None)
        if own is not None and own.rotation is not None:
            position[row], rotation[row], has_pose[row] = own.position, own.rotation, True
    return replace(tool, position=position, rotation=rotation, has_pose=has_pose, track=None)


def _excess(state: State) -> float:
    """Mean square of the whitened residuals of the worst part: a tool, or the references."""
    return max(float(np.sum(part.white**2)) / max(part.count, 1) for part in state.parts)


def _moves(problem: Problem) -> bool:
    """Whether a tool was at places and in orientations that distinguish effects."""
    for tool in problem.tools:
        spread = np.linalg.norm(np.std(tool.position, axis=0))
        closest = float(np.linalg.norm(tool.rotation.mean(axis=0), -2))
        turn = np.sqrt(2 * max(0.0, 1.0 - closest))
        if spread > LEAST_SPREAD_M and turn > LEAST_TURN_RAD:
            return True
    return False


LIVE = 'live'
"""What stands in place of a path in the sessions of a running system."""
MARGIN_NS = 1_000_000_000
"""How much longer than fluxes poses are kept, ns, because their clock may be ahead."""


@dataclass
class FluxRows:
    """Holds readings of one topic: stamp, fluxes (S, K) and flags (S,), of the same channels."""

    channel: Integers | None = None
    rows: deque[tuple[int, ComplexArray, Integers]] = field(default_factory=deque)

    def stream(self) -> RecordedFluxes | None:
        """Return them as if they had been recorded; None without any."""
        if not self.rows or self.channel is None:
            return None
        stamps, flux, flags = zip(*self.rows, strict=True)
        return RecordedFluxes(np.array(stamps), self.channel, np.array(flags), np.array(flux))


class SlidingWindow:
    """Keeps what came in the last seconds by the stamps, thinned to a number of frames.

    ``tool`` and ``reference`` are the readings of the two topics, of which at most so many
    ``frames`` are kept, spread evenly over the window;
    ``first_ns`` the stamp of the first reading of all, 0 before; ``restarts`` how often time ran
    backwards, and all was forgotten.
    """

    def __init__(self, setup: Setup, length_s: float, frames: int) -> None:
        self.setup = setup
        self._length_ns = round(length_s / NANO)
        self._step_ns = self._length_ns // frames
        self.first_ns, self.restarts = 0, 0
        self.tool, self.reference = FluxRows(), FluxRows()
        self._poses: dict[str, deque[tuple[int, tuple[float, ...]]]] = {}

    def take_pose(self, body: str, stamp_ns: int, pose: Sequence[float]) -> None:
        """Keep an optical pose (x y z in m, quaternion x y z w), unless it is late or no pose."""
        values = (*pose[:3], *unit_quaternions(pose[3:]).tolist())
        if not np.isfinite(values).all():
            return
        rows = self._poses.setdefault(body, deque())
        order = order_of(stamp_ns, rows[-1][0] if rows else 0)
        if order in (Order.SAME, Order.LATE):
            return
        if order is Order.BACK:
            rows.clear()
        rows.append((stamp_ns, values))
        # The poses' clock may be ahead of the fluxes'.
        while rows[0][0] < stamp_ns - self._length_ns - MARGIN_NS:
            rows.popleft()

    def take(self, fluxes: FluxRows, stamp_ns: int, points: FluxPoints) -> None:
        """Keep one topic's fluxes of a stamp, unless they are late or too close to the last."""
        channel = np.asarray(points.channel, dtype=np.int64)
        rows = fluxes.rows
        if order_of(stamp_ns, rows[-1][0] if rows else 0) is Order.BACK:
            self._forget()
        elif rows and stamp_ns < rows[-1][0] + self._step_ns:
            return
        if fluxes.channel is None or not np.array_equal(channel, fluxes.channel):
            fluxes.channel = channel
            rows.clear()
        self.first_ns = self.first_ns or stamp_ns
        rows.append((stamp_ns, np.array(points.flux), np.array(points.flags, dtype=np.int64)))
        while rows[0][0] < stamp_ns - self._length_ns:
            rows.popleft()

    def _forget(self) -> None:
        """Start again: a replay has begun again, or the clock was set."""
        self.restarts += 1
        self.first_ns = 0
        self.tool.rows.clear()
        self.reference.rows.clear()

    @property
    def span_s(self) -> float:
        """Return the time between the oldest and the newest reading that is kept, s."""
        spans = [f.rows[-1][0] - f.rows[0][0] for f in (self.tool, self.reference) if f.rows]
        return max(spans, default=0) * NANO

    def session(self) -> Session | None:
        """Return what is in the window, None without fluxes; raises `BagError` as `session_of`."""
        tool, reference = self.tool.stream(), self.reference.stream()
        if tool is None and reference is None:
            return None
        optical = {}
        for body, rows in self._poses.items():
            values = np.array([pose for _, pose in rows])
            stamps = np.array([stamp for stamp, _ in rows])
            optical[body] = PoseStream(stamps, values[:, :3], values[:, 3:])
        return session_of(Bag(LIVE, self.setup, '', tool, reference, optical))
