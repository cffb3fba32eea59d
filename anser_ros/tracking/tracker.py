"""Turns fluxes into poses with a state each, for the live node and the offline evaluation alike.

The steps of a frame, in order: intake and freshness judge the readings; effects of the model are
undone; each coil is solved by itself (`coil_track`), then each body by all of its coils
(`body_track`), then what an application follows besides (`Observer`); poses are compared with each
other and with their past (`judgement`). A pose is good only when its state is ``ok``; only good
poses start the next frame's solve, and a warm solve that misses the gate is repeated without any
guess.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np

from anser_ros import pose_states as states
from anser_ros.arrays import AnyArray, Array, Booleans, ComplexArray, Integers
from anser_ros.effects.correction import Correction
from anser_ros.errors import TrackingError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import FAULTS, GOOD, STUCK_CODE, Frame, Freshness, Intake, value_codes
from anser_ros.integrity.pose_checks import distances
from anser_ros.physics.rotations import quaternion_of_axis, rotation_of_quaternion
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import Withheld
from anser_ros.stamps import NANO
from anser_ros.tracking import rigid
from anser_ros.tracking.body_step import BodyMemory, follow_body
from anser_ros.tracking.body_track import BodyFrame, BodyResult, BodyTrack, solve_with, track_body
from anser_ros.tracking.coil_step import Followed, freedom_of, rules_of
from anser_ros.tracking.coil_track import CoilFrame, CoilResult, CoilTracks, track_coil
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.judgement import Judgement
from anser_ros.tracking.solve_context import (
    FEWEST_EMITTERS,
    ReducedScene,
    SolveContext,
    build_context,
    depends_on,
    without_dead,
)
from anser_ros.tracking.strengths import EmitterStrengths, Look


def _add(counters: Counter[str], name: str, by: int) -> None:
    counters[name] += by


class Observer(Protocol):
    """Works out what an application needs besides the poses of coils and bodies."""

    def forget(self) -> None:
        """Drop the last poses, so that the next solves start cold."""

    def observe(self, bodies: Sequence[BodyFrame]) -> None:
        """Take in one frame of all bodies, after their coils were solved each by itself."""


class Past:
    """Holds what a tracker has seen so far of its sensors and bodies."""

    def __init__(self, sensors: SensorTable, observers: Sequence[Observer]) -> None:
        self.counters: Counter[str] = Counter()
        self.coils = CoilTracks(len(sensors))
        self.bodies = {name: BodyTrack() for name in dict.fromkeys(sensors.body)}
        self.observers = observers
        # It holds the counters and not the tracker: in a cycle, a tracker that was replaced would
        # keep its tables until a collection of garbage, of which a running node makes few.
        count = partial(_add, self.counters)
        self.intake = Intake(sensors.channel, count, spares_dead=True, error=TrackingError)
        self.freshness = Freshness()
        self.judgement = Judgement()
        self.strengths = EmitterStrengths()
        self.first_ns = 0

    def forget(self) -> None:
        self.judgement.forget()
        self.strengths.forget(None, self.strengths.tools)
        self.coils.forget()
        for body in self.bodies.values():
            body.forget()
        for observer in self.observers:
            observer.forget()


@dataclass
class TrackedScene:
    """Holds what frames are solved with: a model made ready, and the tools as it knows them."""

    sensors: SensorTable  # As surveyed
    model: FieldModel | None = None
    context: SolveContext | None = None  # Of the model
    correction: Correction | None = None  # Of the model's effects
    table: SensorTable = field(init=False)  # The sensors as the model's effects have them
    # Rows and coils of the bodies whose six degrees of freedom their coils see
    bodies: dict[str, tuple[Integers, rigid.BodyCoils]] = field(init=False)
    # The same of those whose coils are all parallel
    parallel: list[tuple[Integers, rigid.BodyCoils]] = field(init=False)
    # The context of the last frame in which emitters were dead
    reduced: ReducedScene | None = None

    def __post_init__(self) -> None:
        corrected = self.correction
        self.table = table = self.sensors if corrected is None else corrected.sensors()
        changes = None if corrected is None else corrected.gain_changes()
        self.bodies, self.parallel = {}, []
        for body in dict.fromkeys(table.body):
            rows = np.array([i for i, name in enumerate(table.body) if name == body])
            coils = rigid.BodyCoils(
                table.position[rows], table.axis[rows], table.length[rows],
                None if changes is None else changes[:, rows],
            )  # fmt: skip
            if coils.observable:
                self.bodies[body] = (rows, coils)
            elif len(rows) > 1:
                self.parallel.append((rows, coils))

    def with_model(
        self, model: FieldModel, settings: TrackerSettings, model_id: str | None = None
    ) -> 'TrackedScene':
        """Return the scene of another model; what has not changed is kept."""
        context = build_context(model, settings, self.context, model_id)
        if self.model is None or model.effects is not self.model.effects:
            correction = Correction.of(model.effects, self.sensors, model.frequencies_hz)
            return TrackedScene(self.sensors, model, context, correction, self.reduced)
        scene = copy(self)
        scene.model, scene.context = model, context
        return scene


class Tracker:
    """Tracks all tool sensors and rigid bodies of a setup.

    Without a ``model`` every state is ``no_model``. Of the ``sensors``, positions and axes in
    their body's frame, those that are sums of windings are left out; ``observers`` are what else
    is followed. ``past`` is that of another tracker of these sensors, from which this one goes on,
    and ``scene`` was made of the model before.

    The ``counters`` are ``frames``, ``cold_starts``, ``duplicates``; ``time_jumps`` back,
    ``time_jumps_forward`` beyond the age of a warm start; ``frames_empty``,
    ``frames_dead_emitter``; and sensors' readings that were not used: ``readings_missing``,
    ``readings_saturated``, ``readings_stale``, ``readings_dropped``, ``readings_not_finite``,
    ``readings_absurd``, ``readings_stuck``.

    Raises `TrackingError` when there is no sensor, a channel or name appears twice, or the model
    can't be used; `ModelFileError` when an effect of the model is not one that can be undone.
    """

    def __init__(
        self,
        model: FieldModel | None,
        sensors: SensorTable,
        settings: TrackerSettings | None = None,
        observers: Sequence[Observer] = (),
        *,
        past: Past | None = None,
        scene: TrackedScene | None = None,
    ) -> None:
        self.settings = settings or TrackerSettings()
        if past is None:
            sensors = _checked(sensors)
            past = Past(sensors, observers)
        self.sensors, self._past = sensors, past
        if scene is None:
            scene = TrackedScene(sensors)
            if model is not None:
                scene = scene.with_model(model, self.settings)
        self._scene = scene

    @property
    def counters(self) -> Counter[str]:
        return self._past.counters

    @property
    def model(self) -> FieldModel | None:
        return self._scene.model

    @property
    def dead_emitters(self) -> tuple[str, ...]:
        """Return emitters that no sensor received in the last frame while others were received."""
        return self._past.intake.dead

    @property
    def emitter_strengths(self) -> str:
        """Return which emitters' strengths the tools have shown to differ from the model's."""
        model = self.model
        return '' if model is None else self._past.strengths.words(model.emitters)

    @property
    def drifting_effects(self) -> tuple[str, ...]:
        """Return the model's effects left to the references: no recorded course applies."""
        correction = self._scene.correction
        return () if correction is None or self.settings.recorded_drift else correction.drifting

    @property
    def corrected_effects(self) -> tuple[str, ...]:
        """Return the model's effects that are undone on what is measured."""
        correction = self._scene.correction
        return () if correction is None else correction.corrected

    @property
    def bodies(self) -> tuple[str, ...]:
        """Return the bodies that get a 6-DoF pose."""
        return tuple(self._scene.bodies)

    def with_model(self, model: FieldModel, model_id: str | None = None) -> 'Tracker':
        """Return the same tracker with another field model; warm starts and counters go on.

        What its first frame needs of the model is worked out here, in whatever thread that is.
        Raises `TrackingError` when the model can't be used; this tracker is as it was.
        """
        scene = self._scene.with_model(model, self.settings, model_id)
        assert scene.context is not None
        scene.context.make_ready()
        return self._copy(scene)

    def renamed(self, model_id: str) -> 'Tracker':
        """Return the same tracker whose model has another name: one found again, but the same."""
        scene = copy(self._scene)
        if scene.context is not None:
            scene.context = replace(scene.context, model_id=model_id)
        return self._copy(scene)

    def with_settings(self, settings: TrackerSettings) -> 'Tracker':
        """Return the same tracker with other settings; warm starts and counters go on."""
        scene = self._scene
        if depends_on(settings) != depends_on(self.settings) and scene.model is not None:
            assert scene.context is not None
            bare = replace(scene, context=None, reduced=None)
            scene = bare.with_model(scene.model, settings, scene.context.model_id)
        return Tracker(scene.model, self.sensors, settings, past=self._past, scene=scene)

    def _copy(self, scene: TrackedScene) -> 'Tracker':
        return Tracker(scene.model, self.sensors, self.settings, past=self._past, scene=scene)

    def reset(self) -> None:
        """Forget all warm starts, and what was seen of the sensors and bodies so far."""
        self._past.forget()

    def update(
        self,
        stamp_ns: int,
        channels: AnyArray,
        flux: AnyArray,
        flags: AnyArray | None = None,
        withheld: Withheld | None = None,
        learns: bool = True,
    ) -> list[PoseEstimate]:
        """Estimate the poses of one frame: one a sensor, then one a rigid body.

        ``stamp_ns`` is the middle of the demodulation window; ``channels`` (S,) are those of the
        rows of ``flux`` (S, K), T, in any order, of which unknown ones are passed over; ``flags``
        (S,) are bits of `wire.points`; ``withheld`` is why no pose may be given for this frame;
        ``learns`` is whether tools show the emitters' strengths, which no reference follows.
        There are none for a frame that was already seen. Raises `TrackingError` when the stamp is
        not positive, shapes don't fit, a channel appears twice, or the emitters are not as many as
        the model's.
        """
        names = None if self.model is None else self.model.emitters
        frame = self._past.intake.admit(
            stamp_ns, channels, flux, flags, names, self.settings.warm_age_s
        )
        return [] if frame is None else self._track(frame, withheld, learns)

    def _track(self, frame: Frame, withheld: Withheld | None, learns: bool) -> list[PoseEstimate]:
        past, context = self._past, self._scene.context
        if frame.goes_back:
            self.reset()
        frame = past.freshness.judged(frame, self.settings.flux_noise_t)
        past.first_ns = past.first_ns or frame.stamp_ns
        if context is None:
            return self._without_poses(frame, states.NO_MODEL, '', 'no field model yet')
        state, reason = '', ''
        if withheld is not None:
            state, reason = withheld.state, withheld.reason
        elif frame.living is not None and frame.living.sum() < FEWEST_EMITTERS:
            state, reason = states.NO_SIGNAL, self._few_emitters(frame.living)
        if state:
            return self._without_poses(frame, state, context.model_id, reason)
        flux, codes = self._corrected(frame)
        strengths = past.strengths
        if not learns or strengths.field is not context.field:
            strengths.forget(context.field, self.settings.tools)
        if strengths.used is not None:
            flux = flux / (1.0 + strengths.used)
            context = context.with_strengths(strengths.errors)
        if frame.living is not None:
            self._scene.reduced = without_dead(context, frame.living, self._scene.reduced)
            flux, context = flux[:, frame.living], self._scene.reduced.context
        learns = learns and frame.living is None and strengths.is_due(frame.stamp_ns)
        return self._solved(frame.stamp_ns, np.ascontiguousarray(flux), codes, context, learns)

    def _few_emitters(self, living: Booleans) -> str:
        emitters = () if self.model is None else self.model.emitters
        silent = [name for name, lives in zip(emitters, living, strict=True) if not lives]
        return (
            f'no flux of {", ".join(silent)}; {living.sum()} emitters are left, '
            f'{min(FEWEST_EMITTERS, len(living))} needed'
        )

    def _corrected(self, frame: Frame) -> tuple[ComplexArray, Integers]:
        """Fluxes (S, K) without what the model's effects did to them, and the readings' codes."""
        correction = self._scene.correction
        if correction is None or not correction.changes_flux:
            return frame.flux, frame.codes
        time = (frame.stamp_ns - self._past.first_ns) * NANO
        recorded = self.settings.recorded_drift
        sound = correction.flux(time, self.sensors.channel, frame.flux, recorded=recorded)
        flux = np.asarray(sound, dtype=np.complex128)
        # A correction may carry one sensor's absurd value over to another.
        codes = np.where(frame.codes == GOOD, value_codes(flux), frame.codes)
        return flux, codes

    def _solved(
        self, stamp_ns: int, flux: ComplexArray, codes: Integers, context: SolveContext,
        learns: bool,
    ) -> list[PoseEstimate]:  # fmt: skip
        """Return the poses of fluxes (S, K) whose readings are good or bad by ``codes`` (S,)."""
        values = flux.view(np.float64)
        coils, ended = self._solved_coils(stamp_ns, values, codes, context)
        bodies = []
        for name, (rows, table) in self._scene.bodies.items():
            frame = BodyFrame(
                name, stamp_ns, values[rows], context, self.settings, table,
                [coils[i] for i in rows.tolist()], rows, ended, self._past.coils.rules,
            )  # fmt: skip
            if context.symmetry is not None:
                reason = 'the field is the same all around its axis: a turn about it stays unknown'
                result = BodyResult(frame, frame.no_pose(states.AMBIGUOUS, reason))
            else:
                result = track_body(self._past.bodies[name], frame)
            bodies.append(result)
        for observer in self._past.observers:
            observer.observe([body.frame for body in bodies])
        if learns:
            looks = self._looks(bodies, coils, ended, values, context)
            self._past.strengths.learn(stamp_ns, looks)
        loose = [*self._scene.parallel]
        loose += [(one.frame.rows, one.frame.coils) for one in bodies if one.fit is None]
        if context.symmetry is not None:
            loose = []  # where coils are about the axis of the field is not known
        judged = self._past.judgement.judged(stamp_ns, coils, bodies, self.settings, loose)
        model = self.model
        if model is not None and model.shift_sigma_m > 0.0:
            # No judge reckons with it: what all poses share contradicts none of them.
            names, shift = (*self._scene.table.body, *self._scene.bodies), model.shift_covariance
            turns = dict(zip(names, (one.rotation for one in judged), strict=True))
            shifts = {name: shift(name, turn) for name, turn in turns.items()}
            for name, one in zip(names, judged, strict=True):
                one.covariance += shifts[name]
        return judged

    def _looks(
        self, bodies: Sequence[BodyResult], coils: Sequence[CoilResult], ended: Followed,
        values: Array, context: SolveContext,
    ) -> Iterator[Look]:  # fmt: skip
        """What emitters' strengths can be learnt from: bodies, and the coils that are of none."""
        yield from ((body.frame, body.fit) for body in bodies if body.fit is not None)
        grouped = {row for body in bodies for row in body.frame.rows.tolist()}
        stamp_ns = coils[0].estimate.stamp_ns
        for row, (estimate, found, _, among_metal, _) in enumerate(coils):
            if found is not None and row not in grouped and not among_metal:
                one = rigid.BodyCoils.single(float(self._scene.table.length[row]))
                frame = BodyFrame(
                    estimate.name, stamp_ns, values[row : row + 1], context, self.settings, one,
                    [], np.array([row]), ended, self._past.coils.rules,
                )  # fmt: skip
                turn = rotation_of_quaternion(np.array(quaternion_of_axis(found.axis)))
                yield frame, solve_with(frame, np.zeros(1, np.int64), (found.position, turn))

    def _solved_coils(
        self, stamp_ns: int, values: Array, codes: Integers, context: SolveContext
    ) -> tuple[list[CoilResult], Followed]:
        """Return what is found of each coil, and where the solves of all ended."""
        table, past, settings, results = self._scene.table, self._past, self.settings, []
        tracks, lengths = past.coils, table.length
        ended = tracks.follow(stamp_ns, values, codes == GOOD, lengths, context, settings)
        followed = tracks.followed(stamp_ns, table.name, ended, context.model_id)
        for i, (name, code, known) in enumerate(
            zip(table.name, codes.tolist(), followed, strict=True)
        ):
            if known is not None:
                results.append(known)
                continue
            frame = CoilFrame(
                name, stamp_ns, values[i], context, settings, float(lengths[i]), i, tracks,
                tracks.freedom,
            )  # fmt: skip
            fault = FAULTS[code]
            if fault is None:
                result = track_coil(frame, ended)
                past.counters['cold_starts'] += result.cold
            else:
                past.counters[f'readings_{fault.kind}'] += 1
                reason = past.freshness.reason(i) if code == STUCK_CODE else fault.reason
                result = CoilResult(frame.no_pose(fault.state, reason), None)
            if (one := result.solution) is not None:
                ended.position[i], ended.axis[i], ended.normal[i] = one[0], one[1], one.normal
                ended.covariance[i] = result.estimate.covariance
                result.estimate.covariance = ended.covariance[i]
            results.append(result)
        return results, ended

    def _without_poses(
        self, frame: Frame, state: str, model_id: str, reason: str
    ) -> list[PoseEstimate]:
        names = (*self._scene.table.name, *self._scene.bodies)
        return [no_pose(name, frame.stamp_ns, state, model_id, reason) for name in names]


def _checked(sensors: SensorTable) -> SensorTable:
    """The single coils among sensors; raises `TrackingError` where they cannot be tracked."""
    sensors = sensors.select(sensors.is_single)
    if len(sensors) == 0:
        raise TrackingError('there is no tool sensor to track that is a single coil')
    if len(set(sensors.channel.tolist())) != len(sensors):
        raise TrackingError('a channel appears twice in the sensors')
    if len(set(sensors.name)) != len(sensors):
        raise TrackingError('a name appears twice in the sensors')
    return sensors


def warm_up() -> None:
    """Track a small made-up tool until its motion is carried on, with and without uncertainty."""
    side = np.linspace(-0.1, 0.1, 3)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    positions = np.stack([x, y, np.zeros(9)], axis=1)
    directions = np.tile([0.0, 0.0, 1.0], (9, 1))
    names = tuple(f'coil{k}' for k in range(9))
    moments = 0.02 * np.eye(9, dtype=np.complex128)
    modes = np.stack([1e-4 * moments, 1e-4j * moments])
    sensors = SensorTable(
        channel=np.arange(3),
        name=('a', 'b', 'c'),
        body=('tool', 'tool', 'tool'),
        position=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.01], [0.0, 0.01, 0.0]]),
        axis=np.eye(3),
        length=np.array([0.0, 0.008, 0.0]),
    )
    settings = TrackerSettings(volume=TrackedVolume((-0.1, -0.1, 0.1), (0.1, 0.1, 0.2)))
    for uncertainty in (None, modes):
        model = FieldModel(
            positions, directions, moments, names, tuple(1000.0 + k for k in range(9)), 0.0,
            uncertainty,
        )  # fmt: skip
        rng = np.random.default_rng(0)
        places = sensors.position + [0.01, 0.02, 0.15]
        flux = model.flux(places, sensors.axis, sensors.length)
        tracker = Tracker(model, sensors, settings)
        for stamp_ns in (1, 300_000_001, 600_000_001):  # frames that strengths are learnt from
            # New noise each time, for a reading that repeats is no reading.
            noise = settings.flux_noise_t * rng.standard_normal((2, *flux.shape))
            tracker.update(stamp_ns, sensors.channel, flux + noise[0] + 1j * noise[1])


def warm_up_bodies(model: FieldModel) -> None:
    """Solve a small made-up body alone, which `warm_up` comes to last."""
    settings = TrackerSettings()
    context = build_context(model, settings)
    coils = rigid.BodyCoils(np.zeros((3, 3)), np.eye(3), np.zeros(3))
    memory, every = BodyMemory.empty(), np.arange(3)
    memory.position[:], memory.rotation[:] = [0.0, 0.0, 0.15], np.eye(3)
    places, normals = np.tile(memory.position[0], (3, 1)), np.tile(np.eye(6), (3, 1, 1))
    flux = model.flux(places, coils.axes, coils.lengths).view(np.float64)
    rules = rules_of(settings, freedom_of(flux.shape[1], context.readings))
    rigid.start_from_grid(context.grid, context.field, coils, flux)
    found = follow_body(
        1, flux, coils.arrays, every, True, (places, coils.axes, normals), every, memory,
        context.arrays, context.middle, rules, (1.0, 1.0),
    )[-1]  # fmt: skip
    distances(
        found.position, found.rotation, np.eye(6), coils.offsets, coils.axes, places, coils.axes,
        normals, np.ones(3, dtype=bool), np.zeros(3),
    )  # fmt: skip
