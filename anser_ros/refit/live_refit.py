"""Makes the field model follow metal that moves, by reference coils.

The calibrated model is kept; what is refitted is the change since a distortion-free baseline. All
emitters illuminate the same metal, so one polarisability per source explains all of them, and a
few dozen readings determine the change of the whole field. See `docs/refit.md`.

The steps of a frame: what can be read (`frame`); coils that jumped by themselves (`jumps`); the
evidence of every hypothesis, without coils that contradict the others (`posterior`, `health`); how
probable each hypothesis is after the frames before (`hypotheses`); the model with the metal, and
its uncertainty (`model`); afterwards what tools contradict (`witness`).
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from anser_ros.arrays import AnyArray, Array, Booleans, ComplexArray
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Frame, Freshness, Intake
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import OTHER_PLACE, REFERENCES_DOUBTFUL
from anser_ros.refit import health
from anser_ros.refit import tables as refit_tables
from anser_ros.refit.clouds import FieldFunction
from anser_ros.refit.frame import Average, BaselineCheck, NoiseLevel, NoiseUnits, checked_baseline
from anser_ros.refit.hypotheses import SLOTS, Banks, Belief, BodySlots
from anser_ros.refit.jumps import (
    LARGEST_RATE,
    LEAST_JUMP_POWER,
    Courses,
    faults_have_ended,
    jumped,
)
from anser_ros.refit.model import (
    FEW_REFERENCES,
    FROZEN,
    POOR,
    POOR_FIT,
    REFIT,
    Assembly,
    RefitResult,
    locate_metal,
)
from anser_ros.refit.moved import FrameMotion
from anser_ros.refit.posterior import Bank, FrameEvidence, median
from anser_ros.refit.witness import ToolReading, Witness
from anser_ros.settings import RefitSettings

DRIFT_SIGMAS = 5.0
"""Standard deviations from which on a coil's drift counts as certain."""
WARM_FRAMES = 4
"""Made-up frames before the first real one: noise takes two differences to be measured, and one
more asks for what needs it. Fewer leave 5 to 10 ms to a frame; more only make the start longer."""


class LiveRefit:
    """Makes a field model follow the readings of reference coils.

    The model was calibrated without the metal; ``baseline`` (S, K), T, are the references'
    readings without it, NaN for a coil that has none. ``drawing`` is the field of the board as
    drawn (`physics.board.Board.field`); without it the model's own dipoles drive the metal, which
    is much less accurate. In the ``volume`` the field must be right. ``tables`` are those of all
    these but the baseline, where they are there already. Raises `FitError` when shapes don't fit,
    a channel appears twice, or there are no references.
    """

    def __init__(
        self, model: FieldModel, references: SensorTable, baseline: ComplexArray,
        settings: RefitSettings | None = None, drawing: FieldFunction | None = None,
        volume: TrackedVolume | None = None, tables: refit_tables.RefitTables | None = None,
    ) -> None:  # fmt: skip
        self.model, self.references = model, references
        self.settings = settings or RefitSettings()
        self.baseline = checked_baseline(model, references, baseline)
        self._tables = tables or refit_tables.build_tables(
            model, references, self.settings, drawing, volume
        )
        self._witness: Witness | None = None
        self._prepare()
        self.reset()
        self._warm_up()
        self.reset()

    def _warm_up(self) -> None:
        """Do once what frames do, with metal and without, or the first take ten times as long."""
        accuracy = self.settings.accuracy
        rng = np.random.default_rng(self.settings.seed)
        for stamp_ns in range(1, 1 + WARM_FRAMES):
            noise = rng.standard_normal((*self.baseline.shape, 2)) * accuracy.flux_noise_t
            flux = self.baseline + noise @ np.array([1.0, 1.0j])
            self.update(stamp_ns, self.references.channel, flux)
        bank, slots = self._bank()
        readings = np.zeros((len(bank.rows), 2))
        seen = bank.evaluate(readings, 1.0)
        health.left_out(bank, seen)
        health.evidence_without(bank, seen, np.arange(1))
        slots.warm_up(readings, 1.0)
        weights = np.zeros(len(bank.names))
        weights[1] = 1.0
        no_drift = np.zeros(bank.width, dtype=complex)
        self._new_assembly().model(0, bank, seen, weights, no_drift, 1.0)

    def _prepare(self) -> None:
        """Compute what depends on the baseline and the references' places."""
        phase, noise_t = self._tables.excitation.phase, self.settings.accuracy.flux_noise_t
        self._units = NoiseUnits(self.baseline, phase, noise_t)
        self._banks = Banks(self._tables, self.baseline, self.settings)
        self._intake = Intake(self.references.channel, error=FitError)
        self._baseline_check = BaselineCheck(self.baseline)
        self._assembly = self._new_assembly()
        field, emitters = self._tables.excitation.field, self.model.emitters
        self._motion = FrameMotion(field, self.references, emitters, noise_t)

    def _new_assembly(self) -> Assembly:
        phase, settings = self._tables.excitation.phase, self.settings
        return Assembly(self.model, phase, settings.accuracy.flux_noise_t, settings.error_modes)

    def reset(self) -> None:
        """Forget all frames, so that the calibrated model is active again."""
        settings = self.settings
        self._noise = NoiseLevel(settings.accuracy.flux_noise_t)
        self._average = Average(settings.average_frames)
        self._watch = health.ReferenceWatch(len(self.references), settings.hold_frames)
        self._freshness = Freshness()
        self._courses = Courses(*self.baseline.shape)
        self._belief = Belief(1 + len(self._tables.priors) + SLOTS, settings.persistence)
        self._motion.forget()
        self._banks.forget()
        self._assembly.forget()
        if self._witness is not None:
            self._witness.forget()
        self._last_ns = 0

    def update(
        self, stamp_ns: int, channels: AnyArray, flux: AnyArray,
        flags: AnyArray | None = None,
    ) -> RefitResult:  # fmt: skip
        """Take in one frame of reference fluxes and return the result of the refit.

        ``channels`` (S,) may come in any order, and unknown ones are passed over; ``flux`` (S, K)
        is in T; a reading with ``flags`` (S,) is not used. Raises `FitError` when shapes don't fit
        or a channel appears twice.
        """
        width = len(self.model.emitters)
        return self.follow(self._intake.judge(stamp_ns, channels, flux, flags, width))

    def follow(self, frame: Frame) -> RefitResult:
        """Take in one frame that has been judged, in the order of the references."""
        stamp_ns, ordered = frame.stamp_ns, frame.flux
        if stamp_ns < self._last_ns:
            self._noise.forget()
            self._average.forget()
            self._freshness = Freshness()
            self._courses = Courses(*self.baseline.shape)
        self._last_ns = stamp_ns
        frame = self._freshness.judged(frame, self.settings.accuracy.flux_noise_t)
        readable, reasons = self._baseline_check.read(frame)
        self._watch.note(readable, reasons, self.settings.min_references, stamp_ns)
        usable = ordered if readable.all() else np.where(readable[:, None], ordered, np.nan)
        level = self._noise.update(self._watch.without_excluded(usable))
        self._look_for_jumps(stamp_ns, usable - self.baseline, level)
        if self._watch.used < self.settings.min_references:
            self._watch.wait(readable)
            return self._too_few(stamp_ns, level)
        used = self._watch.without_excluded(ordered)
        mean, frames = self._average.update(used, level * self.settings.accuracy.flux_noise_t)
        if used is not ordered:
            mean = np.where(np.isfinite(mean), mean, ordered)
        noise = level / math.sqrt(frames)
        values = self._units.of(mean / (1.0 + self._motion.gain) - self.baseline)
        bank, seen = self._judged(stamp_ns, values, noise)
        if self._watch.used < self.settings.min_references:
            return self._too_few(stamp_ns, level)
        result = self._result(stamp_ns, bank, seen, level)
        self._readmit(bank, seen, values, readable, level)
        return result

    def _look_for_jumps(self, stamp_ns: int, change: ComplexArray, level: float) -> None:
        """Leave out coils whose change (S, K) has just jumped by itself."""
        jumps = self._courses.follow(stamp_ns, change)
        parts = self._units.of(jumps.off) / jumps.spread[:, None, None]
        power = np.einsum('skp,skp->s', parts, parts) / parts[0].size
        jumping, away = power > LEAST_JUMP_POWER * level**2, self._courses.away()
        if not (jumping.any() or away.size):
            return
        coils = np.flatnonzero(self._in_use())
        self._courses.note(jumps, away[jumping[away]])
        back = self._courses.returned(level * self.settings.accuracy.flux_noise_t)
        few = coils.size < self.settings.min_references or self._watch.is_outvoted
        drift, banks = self.settings.emitter_drift, self._banks.of
        if few and faults_have_ended(self._courses, self._units, banks, level, drift):
            back = self._courses.forget_jumps()
        for coil in back.tolist():
            self._watch.recover(coil)
        # The first frame has no course, and the second only the noise that was stated: metal may
        # be there, and `_judged` asks who disagrees.
        if not (jumping[coils].any() and self._noise.is_measured and math.isfinite(jumps.since_s)):
            return
        bank, _ = self._bank()
        seen = bank.evaluate(parts[coils].reshape(-1, 2), level)
        largest = LARGEST_RATE * jumps.since_s * self._units.size
        spread = float(np.median(jumps.spread[coils]))
        found = coils[jumped(bank, seen, parts[coils], spread, drift, largest)]
        for coil in found.tolist():
            self._watch.exclude(coil)
        if found.size:
            self._courses.note(jumps, found)
            self._average.forget()

    def _in_use(self) -> Booleans:
        return np.asarray(~self._watch.excluded)

    def _bank(self) -> tuple[Bank, BodySlots]:
        """Return the hypotheses for the coils in use."""
        return self._banks.of(self._in_use())

    def _judged(self, stamp_ns: int, values: Array, noise: float) -> tuple[Bank, FrameEvidence]:
        """Evaluate the hypotheses, leaving out coils that are at fault, the worst first."""
        while True:
            (bank, slots), coils = self._bank(), np.flatnonzero(self._in_use())
            used = values[coils].reshape(-1, 2)
            slots.fill(used, noise, stamp_ns)
            seen = bank.evaluate(used, noise)
            self._distance, self._residual = health.left_out(bank, seen)
            if len(coils) <= self.settings.min_references:
                return bank, seen
            power = np.einsum('ij,ij->i', *[used.reshape(len(coils), -1)] * 2) / noise**2
            suspects = self._watch.suspects(self._distance, power, 2 * bank.width)
            faulty = health.find_faults(bank, seen, suspects)
            if not faulty.size:
                return bank, seen
            for coil in faulty:
                self._watch.exclude(int(coils[coil]))
            self._average.forget()

    def _readmit(
        self, bank: Bank, seen: FrameEvidence, values: Array, readable: Booleans,
        level: float,
    ) -> None:  # fmt: skip
        """Readmit excluded coils that agree with the others again."""
        if self._watch.used == self._watch.count:
            return
        k = bank.width
        for coil in np.flatnonzero(self._watch.excluded & readable):
            rows = coil * k + np.arange(k)
            distance = health.distance_of(bank, seen, rows, values[coil], level)
            self._watch.agreed(int(coil), distance < health.AGREEMENT_CHI2 * 2 * k)
        self._watch.readmit()

    def _result(self, stamp_ns: int, bank: Bank, seen: FrameEvidence, level: float) -> RefitResult:
        self._belief.update(seen.log_evidence)
        self._motion.look(stamp_ns, bank, seen)
        weights, moving = self._belief.weights, self._belief.may_have_changed
        best = int(weights.argmax())
        typical = median(self._distance) / (2 * bank.width)
        mean, variance = bank.drifts(seen, best)
        drift = self.settings.emitter_drift * mean.view(np.complex128)[:, 0]
        sure = (np.abs(mean) > DRIFT_SIGMAS * np.sqrt(np.maximum(variance, 1e-30))).any(axis=1)
        if not moving:
            drift[~sure] = 0.0
        drift += self._motion.gain
        model, state, reason = self.model, FROZEN, ''
        unit = self.settings.accuracy.flux_noise_t
        if self._witness is not None and moving:
            self._witness.predict(stamp_ns, bank, seen, weights, drift)
        elif self._witness is not None:
            self._witness.forget()
        if moving or drift.any():
            witness = self._witness if moving else None
            model = self._assembly.model(stamp_ns, bank, seen, weights, drift, typical, witness)
            state = REFIT
        if self._watch.is_outvoted:
            state = REFERENCES_DOUBTFUL
            reason = (
                f'{self._watch.reason.count(health.DISAGREES)} of {self._watch.count} disagree'
            )
        elif self._motion.reason:
            state, reason = OTHER_PLACE, self._motion.reason
        elif moving and typical > POOR:
            state = POOR_FIT
            reason = f'readings deviate {np.sqrt(typical):.1f} times as much as expected'
        metal = (lambda: locate_metal(bank, seen, weights, unit)) if moving else None
        by_name = dict(zip(bank.names, weights.tolist(), strict=True))
        odds, noise_t, judge = self._belief.log_odds, level * unit, self._healths()
        return RefitResult(
            stamp_ns, model, state, judge, odds, by_name, noise_t, drift, reason, metal
        )

    def enable_witnesses(self, flux_noise_t: float, *, ready: bool = False) -> None:
        """Use `witnessed` from now on; the noise is of the tools' components, T.

        If it must be ``ready``, seconds are spent now, and no later frame waits for them.
        """
        self._witness = Witness(self._tables, self.model, self.settings.tools, flux_noise_t)
        if ready:
            self._witness.make_ready()

    def witnessed(self, readings: Sequence[ToolReading]) -> None:
        """Take in what tools read in the last frame, after its poses have been given.

        So it is used for the poses of the next frame, and no reading counts twice.
        """
        if self._witness is None:
            return
        if not self._belief.may_have_changed:
            self._witness.learn(readings)
            return
        bank, _ = self._bank()
        self._belief.update_by(bank.names, self._witness.update(readings))

    def _too_few(self, stamp_ns: int, level: float) -> RefitResult:
        """Return to the calibrated model, which is no answer: it is not known where metal is."""
        self._belief.forget()
        self._average.forget()
        if self._witness is not None:
            self._witness.forget()
        count, need = self._watch.used, self.settings.min_references
        self._distance = self._residual = np.empty(0)
        state = REFERENCES_DOUBTFUL if self._watch.is_outvoted else FEW_REFERENCES
        reason = f'{count} usable references, {need} are needed'
        drift = np.zeros(len(self.model.emitters), dtype=complex)
        noise_t = level * self.settings.accuracy.flux_noise_t
        return RefitResult(
            stamp_ns, self.model, state, self._healths(), 0.0, {}, noise_t, drift, reason
        )

    def _healths(self) -> Callable[[], tuple[health.ReferenceHealth, ...]]:
        """Return a function that computes the references' health in this frame."""
        distance, residual, used = self._distance, self._residual, self._in_use()
        reason = self._watch.reason.copy()
        names, noise_t = self.references.name, self.settings.accuracy.flux_noise_t
        return lambda: health.judge_references(names, reason, used, distance, residual, noise_t)
