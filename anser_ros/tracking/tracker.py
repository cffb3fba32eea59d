"""Turns fluxes into poses with a state each, for the live node and the offline evaluation alike.

A frame gives one estimate for every tool sensor (5-DoF) and for every body whose coils fix all six
degrees of freedom. A pose is good only when its state is ``ok``; only good poses start the next
frame's solve, and a warm solve that misses the gate is repeated without any guess.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.effects.correction import Correction
from anser_ros.errors import TrackingError
from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.frames.faults import FAULTS, GOOD, STUCK_CODE, value_codes
from anser_ros.frames.intake import Frame, Intake
from anser_ros.integrity.freshness import Freshness
from anser_ros.physics.sensor import SensorTable
from anser_ros.pose_states import Withheld
from anser_ros.stamps import NANO
from anser_ros.tracking.body_track import BodyResult, BodyTrack, track_body
from anser_ros.tracking.coil_track import CoilResult, CoilTrack, track_coil
from anser_ros.tracking.emitters import FEWEST_EMITTERS, ReducedScene, without_dead
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.judgement import Judgement, RigidBody
from anser_ros.tracking.rigid import BodyCoils
from anser_ros.tracking.solve_context import SolveContext, build_context, depends_on
from anser_ros.tracking.source_track import SourceFrame, SourceTrack, track_source
from anser_ros.tracking.warm_solve import solve_warm

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

__all__ = ['PoseEstimate', 'Tracker', 'TrackerSettings']

PAST = (
    'counters', '_coil_tracks', '_body_tracks', '_source_tracks', 'sources', '_intake',
    '_freshness', '_judgement', '_first_ns',
)  # fmt: skip
"""Attributes of a tracker that hold what it has seen so far."""


def _add(counters: Counter[str], name: str, by: int) -> None:
    counters[name] += by


class Tracker:
    """Tracks all tool sensors and rigid bodies of a setup.

    Parameters
    ----------
    model : FieldModel or None
        None until one is known; every state is then ``no_model``.
    sensors : SensorTable
        The tool sensors, positions and axes in their body's frame. Those that are sums of
        windings are left out.
    settings : TrackerSettings, optional

    Attributes
    ----------
    counters : collections.Counter
        ``frames``, ``cold_starts``, ``duplicates``; ``time_jumps`` back, ``time_jumps_forward``
        beyond the age of a warm start; ``frames_empty``; ``frames_dead_emitter``; and sensors'
        readings that were not used: ``readings_missing``, ``readings_saturated``,
        ``readings_stale``, ``readings_dropped``, ``readings_not_finite``, ``readings_absurd``,
        ``readings_stuck``.
    sources : dict of str to PoseEstimate
        Of each body in the last frame, where the field is the same all around an axis: place (m)
        and axis of the source in the body's frame. A body has no pose of its own there.

    Raises
    ------
    TrackingError
        When there is no sensor, a channel or name appears twice, or the model can't be used.
    ModelFileError
        When an effect of the model is not one that can be undone.
    """

    def __init__(
        self,
        model: FieldModel | None,
        sensors: SensorTable,
        settings: TrackerSettings | None = None,
    ) -> None:
        sensors = sensors.select(sensors.is_single)
        if len(sensors) == 0:
            raise TrackingError('there is no tool sensor to track that is a single coil')
        if len(set(sensors.channel.tolist())) != len(sensors):
            raise TrackingError('a channel appears twice in the sensors')
        if len(set(sensors.name)) != len(sensors):
            raise TrackingError('a name appears twice in the sensors')
        self.settings = settings or TrackerSettings()
        self.sensors = sensors
        self.counters: Counter[str] = Counter()
        self._coil_tracks = {name: CoilTrack() for name in sensors.name}
        self._body_tracks = {name: BodyTrack() for name in dict.fromkeys(sensors.body)}
        self._source_tracks: dict[str, SourceTrack] = {}
        self.sources: dict[str, PoseEstimate] = {}
        # It holds the counters and not the tracker: in a cycle, a tracker that was replaced would
        # keep its tables until a collection of garbage, of which a running node makes few.
        count = partial(_add, self.counters)
        self._intake = Intake(sensors.channel, count, spares_dead=True, error=TrackingError)
        self._freshness = Freshness()
        self._judgement = Judgement()
        self._first_ns: list[int] = []
        self._context: SolveContext | None = None
        self._reduced: ReducedScene | None = None
        self._effects: tuple[EffectRecord, ...] = ()
        self._correction: Correction | None = None
        self._table = sensors
        self._find_bodies()
        self._use(model)

    def _use(self, model: FieldModel | None, model_id: str | None = None) -> None:
        if model is not None:
            context = build_context(model, self.settings, self._context, model_id)
            if model.effects is not self._effects or self._correction is None:
                self._correction = Correction.of(model.effects, self.sensors, model.frequencies_hz)
                self._table = self._correction.sensors()
                self._find_bodies()
            self._context, self._effects = context, model.effects
        self._model = model

    def _find_bodies(self) -> None:
        """Determine which coils make bodies whose six degrees of freedom they see."""
        table = self._table
        self._bodies: dict[str, tuple[NDArray[np.int64], BodyCoils]] = {}
        for body in self._body_tracks:
            rows = np.array([i for i, name in enumerate(table.body) if name == body])
            changes = None if self._correction is None else self._correction.gain_changes()
            coils = BodyCoils(
                table.position[rows], table.axis[rows], table.length[rows],
                None if changes is None else changes[:, rows],
            )  # fmt: skip
            if coils.observable:
                self._bodies[body] = (rows, coils)

    @property
    def model(self) -> FieldModel | None:
        """Return the field model in force, or None."""
        return self._model

    @property
    def dead_emitters(self) -> tuple[str, ...]:
        """Return emitters that no sensor received in the last frame while others were received."""
        return self._intake.dead

    @property
    def drifting_effects(self) -> tuple[str, ...]:
        """Return the model's effects left to the references: no recorded course applies."""
        if self._correction is None or self.settings.recorded_drift:
            return ()
        return self._correction.drifting

    @property
    def corrected_effects(self) -> tuple[str, ...]:
        """Return the model's effects that are undone on what is measured."""
        return () if self._correction is None else self._correction.corrected

    @property
    def bodies(self) -> tuple[str, ...]:
        """Return the bodies that get a 6-DoF pose."""
        return tuple(self._bodies)

    def with_model(self, model: FieldModel, model_id: str | None = None) -> 'Tracker':
        """Return the same tracker with another field model; warm starts and counters go on.

        What its first frame needs of the model is worked out here, in whatever thread that is.

        Raises
        ------
        TrackingError
            When the model can't be used; this tracker is as it was.
        """
        other = Tracker.__new__(Tracker)
        other.__dict__.update(self.__dict__)
        other._use(model, model_id)
        if other._context is not None:
            other._context.make_ready()
        return other

    def renamed(self, model_id: str) -> 'Tracker':
        """Return the same tracker whose model has another name: one found again, but the same."""
        other = Tracker.__new__(Tracker)
        other.__dict__.update(self.__dict__)
        if self._context is not None:
            other._context = replace(self._context, model_id=model_id)
        return other

    def with_settings(self, settings: TrackerSettings) -> 'Tracker':
        """Return the same tracker with other settings; warm starts and counters go on."""
        other = Tracker.__new__(Tracker)
        other.__dict__.update(self.__dict__)
        other.settings = settings
        if depends_on(settings) == depends_on(self.settings):
            return other
        if self._model is not None and self._context is not None:
            model_id, other._context, other._reduced = self._context.model_id, None, None
            other._use(self._model, model_id)
        return other

    def with_past_of(self, other: 'Tracker') -> 'Tracker':
        """Return a tracker like this one that goes on from where another one of its sensors is.

        What it sees from now on, the other one has seen, and this one has not.
        """
        new = Tracker.__new__(Tracker)
        new.__dict__.update(self.__dict__)
        new.__dict__.update({name: other.__dict__[name] for name in PAST})
        return new

    def reset(self) -> None:
        """Forget all warm starts, and what was seen of the sensors and bodies so far."""
        self._judgement.forget()
        for coil in self._coil_tracks.values():
            coil.forget()
        for body in self._body_tracks.values():
            body.forget()
        for source in self._source_tracks.values():
            source.forget()

    def update(
        self,
        stamp_ns: int,
        channels: NDArray[np.generic],
        flux: NDArray[np.generic],
        flags: NDArray[np.generic] | None = None,
        withheld: Withheld | None = None,
    ) -> list[PoseEstimate]:
        """Estimate all poses from one frame; arguments and errors are those of `estimates`."""
        return list(self.estimates(stamp_ns, channels, flux, flags, withheld))

    def estimates(
        self,
        stamp_ns: int,
        channels: NDArray[np.generic],
        flux: NDArray[np.generic],
        flags: NDArray[np.generic] | None = None,
        withheld: Withheld | None = None,
    ) -> Iterator[PoseEstimate]:
        """Estimate the poses of one frame.

        Parameters
        ----------
        stamp_ns : int
            Middle of the demodulation window; must be positive.
        channels : ndarray, shape (S,)
            Channel of each row, in any order; unknown ones are passed over.
        flux : ndarray, shape (S, K), complex
            T.
        flags : ndarray, shape (S,), optional
            Flag bits of `wire.points`.
        withheld : Withheld, optional
            Why no pose may be given for this frame.

        Yields
        ------
        PoseEstimate
            One a sensor, then one a rigid body. None for a frame that was already seen.

        Raises
        ------
        TrackingError
            Before the first estimate: when the stamp is not positive, shapes don't fit, a channel
            appears twice, or the emitters are not as many as the model's.
        """
        names = None if self._model is None else self._model.emitters
        frame = self._intake.admit(
            stamp_ns, channels, flux, flags, names, self.settings.warm_age_s
        )
        if frame is not None:
            yield from self.track(frame, withheld)

    def track(self, frame: Frame, withheld: Withheld | None = None) -> Iterator[PoseEstimate]:
        """Estimate the poses of a frame that has been judged; yields what `estimates` does.

        Parameters
        ----------
        frame : Frame
            Of an `Intake` of this tracker's sensors that spares dead emitters.
        withheld : Withheld, optional
            Why no pose may be given for it.
        """
        if frame.goes_back:
            self.reset()
        frame = self._freshness.judged(frame, self.settings.flux_noise_t)
        if not self._first_ns:
            self._first_ns.append(frame.stamp_ns)
        context = self._context
        if context is None:
            yield from self._without_poses(frame, states.NO_MODEL, '', 'no field model yet')
            return
        if withheld is not None:
            yield from self._without_poses(
                frame, withheld.state, context.model_id, withheld.reason
            )
            return
        living = frame.living
        if living is not None:
            if living.sum() < FEWEST_EMITTERS:
                names = [name for name, lives in zip(self._emitters, living, strict=True)
                         if not lives]  # fmt: skip
                reason = (
                    f'no flux of {", ".join(names)}; {living.sum()} emitters are left, '
                    f'{FEWEST_EMITTERS} needed'
                )
                model_id = context.model_id
                yield from self._without_poses(frame, states.NO_SIGNAL, model_id, reason)
                return
            self._reduced = without_dead(context, living, self._reduced)
            context = self._reduced.context
        flux, codes = self._corrected(frame)
        if living is not None:
            flux = flux[:, living]
        yield from self._solved(frame.stamp_ns, np.ascontiguousarray(flux), codes, context)

    def _solved(
        self, stamp_ns: int, flux: ComplexArray, codes: NDArray[np.int64], context: SolveContext
    ) -> Iterator[PoseEstimate]:
        """Yield the poses of fluxes (S, K) whose readings are good or bad by ``codes`` (S,).

        None is published before all are known, because they are compared with each other.
        """
        values = flux.view(np.float64)
        coils = self._solved_coils(stamp_ns, values, codes, context)
        bodies = []
        self.sources.clear()
        for name, (rows, table) in self._bodies.items():
            single = [coils[i] for i in rows]
            usable = np.array([coil.usable for coil in single])
            if context.symmetry is not None:
                frame = SourceFrame(
                    name, stamp_ns, table, values[rows], context.symmetry, context, self.settings
                )
                bodies.append(RigidBody(rows, table, self._source(frame, usable)))
                continue
            result = track_body(
                self._body_tracks[name], name, table, stamp_ns, values[rows], usable, single,
                context, self.settings,
            )  # fmt: skip
            bodies.append(RigidBody(rows, table, result))
        judged = self._judgement.judged(stamp_ns, coils, bodies, self.settings)
        if context.shift_sigma_m == 0.0:
            yield from judged
            return
        # No judge reckons with it: what all poses share contradicts none of them.
        yield from (estimate.with_shift(context.shift_sigma_m) for estimate in judged)

    def _source(self, frame: SourceFrame, usable: NDArray[np.bool_]) -> BodyResult:
        """Find the source in a body's frame; its pose stays unknown by a turn about the axis."""
        track = self._source_tracks.setdefault(frame.name, SourceTrack())
        self.sources[frame.name] = track_source(track, frame, usable)
        reason = 'the field is the same all around its axis: a turn about it stays unknown'
        model_id = frame.context.model_id
        return BodyResult(no_pose(frame.name, frame.stamp_ns, states.AMBIGUOUS, model_id, reason))

    def _solved_coils(
        self, stamp_ns: int, values: Array, codes: NDArray[np.int64], context: SolveContext
    ) -> list[CoilResult]:
        """Solve each sensor by itself, from flux components (S, 2K)."""
        table, results = self._table, []
        tracks = [self._coil_tracks[name] for name in table.name]
        warm = solve_warm(
            tracks, table.length, stamp_ns, values, codes == GOOD, context, self.settings
        )
        for i, (name, code) in enumerate(zip(table.name, codes.tolist(), strict=True)):
            fault = FAULTS[code]
            if fault is not None:
                self.counters[f'readings_{fault.kind}'] += 1
                reason = self._freshness.reason(i) if code == STUCK_CODE else fault.reason
                bad = no_pose(name, stamp_ns, fault.state, context.model_id, reason)
                result = CoilResult(bad, None)
            else:
                result = track_coil(
                    tracks[i], name, float(table.length[i]), stamp_ns, values[i], context,
                    self.settings, warm[i],
                )  # fmt: skip
                self.counters['cold_starts'] += result.cold
            results.append(result)
        return results

    def _without_poses(
        self, frame: Frame, state: str, model_id: str, reason: str
    ) -> Iterator[PoseEstimate]:
        """Yield an estimate without a pose for every sensor and body."""
        for name in (*self._table.name, *self._bodies):
            yield no_pose(name, frame.stamp_ns, state, model_id, reason)

    @property
    def _emitters(self) -> tuple[str, ...]:
        return () if self._model is None else self._model.emitters

    def _corrected(self, frame: Frame) -> tuple[ComplexArray, NDArray[np.int64]]:
        """Fluxes (S, K) without what the model's effects did to them, and the readings' codes."""
        if self._correction is None or not self._correction.changes_flux:
            return frame.flux, frame.codes
        time = (frame.stamp_ns - self._first_ns[0]) * NANO
        recorded = self.settings.recorded_drift
        sound = self._correction.flux(time, self.sensors.channel, frame.flux, recorded=recorded)
        flux = np.asarray(sound, dtype=np.complex128)
        # A correction may carry one sensor's absurd value over to another.
        codes = np.where(frame.codes == GOOD, value_codes(flux), frame.codes)
        return flux, codes
