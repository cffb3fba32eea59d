"""From fluxes to poses with a state each: what the live node and the offline evaluation share.

A frame gives one estimate for every tool sensor (5-DoF) and for every body whose coils fix all six
degrees of freedom. A pose is good only when its state is ``ok``; only good poses start the next
frame's solve, and a warm solve that misses the gate is repeated without any guess.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.correction import Correction
from anser_ros.errors import TrackingError
from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.physics.sensor import LARGEST_FLUX_T, SensorTable
from anser_ros.tracking import estimate as states
from anser_ros.tracking.body_track import BodyTrack, track_body
from anser_ros.tracking.coil_track import NANO, CoilResult, CoilTrack, prepare, track_coil
from anser_ros.tracking.emitters import (
    FEWEST_EMITTERS,
    ReducedScene,
    living_emitters,
    without_dead,
)
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.rigid import BodyCoils
from anser_ros.tracking.solve_context import SolveContext, build_context

Array = NDArray[np.float64]

FLAGS = ((1, states.SATURATED), (2, states.STALE), (4, states.DROPPED))
"""Flag bits of a flux point (interfaces, section 3) and the states that they cause."""

__all__ = ['PoseEstimate', 'Tracker', 'TrackerSettings']


class Tracker:
    """Tracks all tool sensors and rigid bodies of a setup.

    Parameters
    ----------
    model : FieldModel or None
        None until one is known; every state is then ``no_model``.
    sensors : SensorTable
        The tool sensors, positions and axes in their body's frame.
    settings : TrackerSettings, optional
    model_id : str, optional
        Name of the model in the estimates; by default a digest of its arrays.

    Attributes
    ----------
    counters : collections.Counter
        ``frames``, ``cold_starts``, ``duplicates``; ``time_jumps`` back, ``time_jumps_forward``
        beyond the age of a warm start; ``frames_empty``; ``frames_dead_emitter``; and sensors'
        readings that were not used: ``readings_missing``, ``readings_saturated``,
        ``readings_stale``, ``readings_dropped``, ``readings_not_finite``, ``readings_absurd``.

    Raises
    ------
    TrackingError
        When there is no sensor, a channel or name appears twice, or the model can't be used.
    ModelFileError
        When an effect of the model is none that can be undone.
    """

    def __init__(
        self,
        model: FieldModel | None,
        sensors: SensorTable,
        settings: TrackerSettings | None = None,
        model_id: str | None = None,
    ) -> None:
        if len(sensors) == 0:
            raise TrackingError('there is no tool sensor to track')
        if len(set(sensors.channel.tolist())) != len(sensors):
            raise TrackingError('a channel appears twice in the sensors')
        if len(set(sensors.name)) != len(sensors):
            raise TrackingError('a name appears twice in the sensors')
        self.settings = settings or TrackerSettings()
        self.sensors = sensors
        self.counters: Counter[str] = Counter()
        self._coil_tracks = {name: CoilTrack() for name in sensors.name}
        self._body_tracks = {name: BodyTrack() for name in dict.fromkeys(sensors.body)}
        self._last_ns = [0]
        self._first_ns: list[int] = []
        self._context: SolveContext | None = None
        self._reduced: ReducedScene | None = None
        self._dead: list[str] = []
        self._effects: tuple[EffectRecord, ...] = ()
        self._correction: Correction | None = None
        self._table = sensors
        self._find_bodies()
        self._use(model, model_id)

    def _use(self, model: FieldModel | None, model_id: str | None) -> None:
        if model is not None:
            context = build_context(model, self.settings, self._context, model_id)
            if model.effects is not self._effects or self._correction is None:
                self._correction = Correction.of(model.effects, self.sensors, model.frequencies_hz)
                self._table = self._correction.sensors()
                self._find_bodies()
            self._context, self._effects = context, model.effects
        self._model = model

    def _find_bodies(self) -> None:
        """Tell which coils make bodies whose six degrees of freedom they see."""
        table = self._table
        self._bodies: dict[str, tuple[NDArray[np.int64], BodyCoils]] = {}
        for body in self._body_tracks:
            rows = np.array([i for i, name in enumerate(table.body) if name == body])
            coils = BodyCoils(table.position[rows], table.axis[rows], table.length[rows])
            if coils.observable:
                self._bodies[body] = (rows, coils)

    @property
    def model(self) -> FieldModel | None:
        """The field model in force."""
        return self._model

    @property
    def dead_emitters(self) -> tuple[str, ...]:
        """Emitters that no sensor heard in the last frame while others were heard."""
        return tuple(self._dead)

    @property
    def drifting_effects(self) -> tuple[str, ...]:
        """Effects of the model that are left to the references: no recorded course applies."""
        if self._correction is None or self.settings.recorded_drift:
            return ()
        return self._correction.drifting

    @property
    def bodies(self) -> tuple[str, ...]:
        """Bodies that get a 6-DoF pose."""
        return tuple(self._bodies)

    def with_model(self, model: FieldModel, model_id: str | None = None) -> 'Tracker':
        """The same tracker with another field model; warm starts and counters go on.

        Raises
        ------
        TrackingError
            When the model can't be used; this tracker is as it was.
        """
        other = Tracker.__new__(Tracker)
        other.__dict__.update(self.__dict__)
        other._use(model, model_id)
        return other

    def renamed(self, model_id: str) -> 'Tracker':
        """The same tracker whose model has another name: one that was found anew, but the same."""
        other = Tracker.__new__(Tracker)
        other.__dict__.update(self.__dict__)
        if self._context is not None:
            other._context = replace(self._context, model_id=model_id)
        return other

    def with_settings(self, settings: TrackerSettings) -> 'Tracker':
        """The same tracker with other settings; warm starts and counters go on."""
        other = Tracker.__new__(Tracker)
        other.__dict__.update(self.__dict__)
        other.settings = settings
        if self._model is not None and self._context is not None:
            model_id, other._context, other._reduced = self._context.model_id, None, None
            other._use(self._model, model_id)
        return other

    def reset(self) -> None:
        """Forget all warm starts."""
        for coil in self._coil_tracks.values():
            coil.forget()
        for body in self._body_tracks.values():
            body.forget()

    def update(
        self,
        stamp_ns: int,
        channels: NDArray[np.generic],
        flux: NDArray[np.generic],
        flags: NDArray[np.generic] | None = None,
    ) -> list[PoseEstimate]:
        """Estimate all poses from one frame; arguments and errors are those of `estimates`."""
        return list(self.estimates(stamp_ns, channels, flux, flags))

    def estimates(
        self,
        stamp_ns: int,
        channels: NDArray[np.generic],
        flux: NDArray[np.generic],
        flags: NDArray[np.generic] | None = None,
    ) -> Iterator[PoseEstimate]:
        """Estimate the poses of one frame, each given out before the next is worked on.

        Parameters
        ----------
        stamp_ns : int
            Middle of the demodulation window; must be positive.
        channels : ndarray, shape (S,)
            Channel of each row, in any order; unknown ones are passed over.
        flux : ndarray, shape (S, K), complex
            T.
        flags : ndarray, shape (S,), optional
            Flag bits: 1 saturated, 2 stale, 4 dropped samples.

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
        rows, values, bits = self._checked(stamp_ns, channels, flux, flags)
        if stamp_ns == self._last_ns[0]:
            self.counters['duplicates'] += 1
            return
        if stamp_ns < self._last_ns[0]:
            self.counters['time_jumps'] += 1
            self.reset()
        elif 0 < self._last_ns[0] < stamp_ns - self.settings.warm_age_s / NANO:
            self.counters['time_jumps_forward'] += 1
        self._last_ns[0] = stamp_ns
        if not self._first_ns:
            self._first_ns.append(stamp_ns)
        self.counters['frames'] += 1
        if not len(channels):
            self.counters['frames_empty'] += 1
        context, table = self._context, self._table
        names = (*table.name, *self._bodies)
        living = living_emitters(values.view(np.complex128), (rows >= 0) & (bits == 0))
        self._note_dead(living)
        if context is None:
            for name in names:
                yield no_pose(name, stamp_ns, states.NO_MODEL, '', 'no field model yet')
            return
        if living is not None:
            if living.sum() < FEWEST_EMITTERS:
                reason = (
                    f'no flux of {", ".join(self._dead)}; {living.sum()} emitters are left, '
                    f'{FEWEST_EMITTERS} needed'
                )
                for name in names:
                    yield no_pose(name, stamp_ns, states.NO_SIGNAL, context.model_id, reason)
                return
            # An emitter that is off leaks nothing into another's tone either.
            values.view(np.complex128)[:, ~living] = 0.0
            self._reduced = without_dead(context, living, self._reduced)
            context = self._reduced.context
        # Arithmetic on an infinity only warns; the kind of a bad value is counted as it came.
        faults = _faults(rows, values, bits)
        values[~np.isfinite(values)] = np.nan
        corrected = self._corrected(stamp_ns, values)
        if corrected is not values:
            values = corrected
            again = _faults(np.zeros_like(rows), values, np.zeros_like(bits))
            faults = [one or other for one, other in zip(faults, again, strict=True)]
        if living is not None:
            values = np.ascontiguousarray(values[:, np.repeat(living, 2)])
        results: list[CoilResult] = []
        tracks = [self._coil_tracks[name] for name in table.name]
        prepare(tracks, table.length, stamp_ns, context, self.settings)
        for i, name in enumerate(table.name):
            refusal = faults[i]
            if refusal is not None:
                self.counters[f'readings_{refusal[2]}'] += 1
                bad = no_pose(name, stamp_ns, refusal[0], context.model_id, refusal[1])
                result = CoilResult(bad, None)
            else:
                result = track_coil(
                    tracks[i], name, float(table.length[i]), stamp_ns, values[i], context,
                    self.settings,
                )  # fmt: skip
                self.counters['cold_starts'] += result.cold
            results.append(result)
            yield result.estimate
        for body, (members, coils) in self._bodies.items():
            usable = np.array([results[i].usable for i in members])
            yield track_body(
                self._body_tracks[body],
                body,
                coils,
                stamp_ns,
                values[members],
                usable,
                [results[i] for i in members],
                context,
                self.settings,
            )

    def _note_dead(self, living: NDArray[np.bool_] | None) -> None:
        """Keep the names of emitters that are not heard (trackers of other models share them)."""
        self._dead.clear()
        if living is None:
            return
        self.counters['frames_dead_emitter'] += 1
        given = None if self._model is None else self._model.emitters
        dead = np.flatnonzero(~living).tolist()
        self._dead.extend(f'emitter {k}' if given is None else given[k] for k in dead)

    def _corrected(self, stamp_ns: int, values: Array) -> Array:
        """Fluxes (S, 2K) without what the model's effects did to them."""
        if self._correction is None or not self._correction.changes_flux:
            return values
        time = (stamp_ns - self._first_ns[0]) * 1e-9
        flux = values.view(np.complex128)
        recorded = self.settings.recorded_drift
        sound = self._correction.flux(time, self.sensors.channel, flux, recorded=recorded)
        return np.ascontiguousarray(sound, dtype=np.complex128).view(np.float64)

    def _checked(
        self,
        stamp_ns: int,
        channels: NDArray[np.generic],
        flux: NDArray[np.generic],
        flags: NDArray[np.generic] | None,
    ) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
        """Rows of the frame (-1: missing), fluxes (S, 2K) and flags in the table's order."""
        if stamp_ns <= 0:
            raise TrackingError(f'a flux frame needs a positive stamp, got {stamp_ns} ns')
        given = np.asarray(flux)
        number = np.asarray(channels, dtype=np.int64)
        marks = np.zeros(number.shape, np.int64) if flags is None else np.asarray(flags)
        if given.ndim != 2 or number.shape != given.shape[:1] or marks.shape != number.shape:
            raise TrackingError(
                f'fluxes (s, k) need s channels and s flags, got {given.shape}, {number.shape} '
                f'and {marks.shape}'
            )
        if self._context is not None and given.shape[1] != self._context.field.emitters:
            raise TrackingError(
                f'the model has {self._context.field.emitters} emitters, '
                f'the fluxes {given.shape[1]}'
            )
        place = {channel: i for i, channel in enumerate(number.tolist())}
        if len(place) != number.size:
            raise TrackingError('a channel appears twice in the frame')
        rows = np.array([place.get(c, -1) for c in self.sensors.channel.tolist()], dtype=np.int64)
        values = np.full((len(rows), given.shape[1]), np.nan, dtype=np.complex128)
        bits = np.zeros(len(rows), dtype=np.int64)
        here = rows >= 0
        values[here], bits[here] = given[rows[here]], marks[rows[here]]
        return rows, values.view(np.float64), bits


def _faults(
    rows: NDArray[np.int64], values: Array, bits: NDArray[np.int64]
) -> list[tuple[str, str, str] | None]:
    """State, reason and kind where a sensor's fluxes must not be used; None for the others."""
    # A comparison with NaN is false, so this is also what is not finite.
    sound = ((np.abs(values) < LARGEST_FLUX_T).all(axis=1) & (rows >= 0) & (bits == 0)).tolist()
    return [None if good else _fault(rows[i], values[i], int(bits[i])) for i, good in
            enumerate(sound)]  # fmt: skip


def _fault(row: int, values: Array, bits: int) -> tuple[str, str, str] | None:
    """State, reason and kind of a sensor whose fluxes must not be used."""
    if row < 0:
        return states.STALE, 'its channel is not in the frame', 'missing'
    for bit, state in FLAGS:
        if bits & bit:
            return state, f'flagged {state} by the acquisition', state
    if bool((np.abs(values) < LARGEST_FLUX_T).all()):
        return None
    if np.isfinite(values).all():
        return states.NO_SIGNAL, f'fluxes beyond {LARGEST_FLUX_T:g} T are absurd', 'absurd'
    return states.NO_SIGNAL, 'the fluxes are not finite', 'not_finite'
