"""Diagnoses a session of few poses of many sensors, down to a body that rests at one place.

A handful of poses cannot show how good a field model is, but hundreds of sensors can show what is
wrong with themselves. The field is therefore estimated anew, together with the sensors and the
body's shape, as a calibration does, after the effects that the given model knows have been
corrected. What is predicted takes no part: each pose, or for one place each fifth of the sensors.
What does not help to predict it is not named.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from anser_ros.apps.lab.calibration_engines import ENGINES
from anser_ros.apps.lab.still import AS_STATED, BEND, PLACEMENT, STILL_ONLY
from anser_ros.arrays import Array
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.held_out import rms
from anser_ros.calibration.result import SPREADS, Calibration
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.diagnosis.decisions import UNSTRUCTURED
from anser_ros.effects.effect import all_effects
from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.sessions.calibration import calibrate_sessions
from anser_ros.sessions.diagnosis import TrackingErrors, document_of, effect_figures
from anser_ros.sessions.prepared import correct, prepare
from anser_ros.sessions.session import Session

LOOKED_FOR = (*KINDS, *STILL_ONLY)
"""Kinds of errors that are estimated."""
KIND_OF = {SPREADS['gains']: 'gains', SPREADS['axes']: 'axes', BEND: 'bend'}
"""Kinds by the effect that they become; without an entry, an effect goes with all kinds."""
CHANCE = 1e-3
"""Probability in noise alone below which what remains depends on a variable."""


@dataclass(frozen=True)
class FewPosesDiagnosis:
    """Holds what is wrong with the sensors of a session of few poses."""

    before: Calibration  # with sensors as the given model has them
    after: Calibration  # with the effects that were found
    effects: tuple[EffectRecord, ...]
    without_t: tuple[float, ...]  # the held-out residual without each effect
    model: FieldModel  # the field as it was estimated, and the effects that were known and found

    @property
    def floor_t(self) -> float:
        """Return the magnitude of noise alone, T rms, at most what remains."""
        is_constant = not self.after.held_out.error.imag.any()
        noise = self.after.held_out.flux_noise_t * (1.0 if is_constant else np.sqrt(2.0))
        return float(min(noise, rms(self.after.held_out.error)))

    @property
    def unexplained(self) -> float:
        """Return the share of the power above the noise that remains, 0 where it may be noise."""
        floor, after = self.floor_t**2, rms(self.after.held_out.error) ** 2
        possible = max(rms(self.before.held_out.error) ** 2 - floor, after - floor)
        return (after - floor) / possible if after - floor > UNSTRUCTURED * floor else 0.0

    @property
    def depends_on(self) -> tuple[str, ...]:
        """Return the variables, of position, channel and emitter, that what remains follows."""
        power = residual_power(self.after)
        axes = ('position', 'channel', 'emitter')
        return tuple(name for axis, name in enumerate(axes) if _differs(power, axis))


REPORT = 'anser_ros.apps.lab.cli.few_poses_report'
"""Module whose ``render`` makes the report; it loads matplotlib."""


def accepts(session: Session) -> bool:
    """Return whether a session has few poses of a body of many sensors, and no drawn emitters."""
    options = Options(session.setup.accuracy, is_joint=True)
    return any(engine.is_joint and engine.accepts([session], options) for engine in ENGINES)


def diagnose(
    session: Session, model: FieldModel, progress: Callable[[str], None] | None = None
) -> FewPosesDiagnosis:
    """Find what is wrong with the sensors of a session that it `accepts`.

    The effects that the model has are corrected first. Raises `ModelFileError` when its emitters
    are not the session's, or an effect of it is unknown, and `FitError` when the readings don't
    determine the field.
    """
    say = progress or (lambda text: None)
    known = correct(prepare(session, model)).session

    def calibrated(kinds: tuple[str, ...], what: str) -> Calibration:
        return calibrate_sessions(
            [known],
            Options(estimate=kinds, is_joint=True),
            lambda stage, share: say(f'{what}: {stage}, {share:.0%}'),
        )

    before = calibrated((), 'with the sensors as they are')
    kinds: tuple[str, ...] = LOOKED_FOR
    while True:
        after = calibrated(kinds, 'with all errors')
        records = (*after.scan.corrections, *after.scan.reported_effects)
        without = {}
        for kind, name in ((KIND_OF[r.name], r.name) for r in records if r.name in KIND_OF):
            rest = tuple(other for other in kinds if other != kind)
            without[name] = rms(calibrated(rest, f'without {name}').held_out.error)
        idle = [KIND_OF[name] for name, t in without.items() if t <= rms(after.held_out.error)]
        if not idle:
            break
        kinds = tuple(kind for kind in kinds if kind not in idle)
    for record in records:
        if record.name == PLACEMENT:
            without[record.name] = record.evidence[AS_STATED]
        elif record.name not in KIND_OF:
            is_corrected = record in after.scan.corrections
            without[record.name] = rms((before if is_corrected else after).held_out.error)
    effects = (*model.effects, *after.scan.corrections)
    return FewPosesDiagnosis(
        before,
        after,
        tuple(map(_described, records)),
        tuple(without[record.name] for record in records),
        replace(after.model, effects=effects),
    )


def _described(record: EffectRecord) -> EffectRecord:
    """The record with words on what it is and what is done about it."""
    effect = all_effects().get(record.name)
    if effect is None:
        return record
    words = {'summary': effect.summary, 'remedy': effect.remedy.value}
    return replace(record, evidence={**words, **record.evidence})


def residual_power(calibration: Calibration) -> Array:
    """Return the squared magnitude (F, S, K), T^2, of the held-out residual of each reading.

    Of a body at one place its mean reading is predicted, F = 1. NaN where nothing was measured.
    """
    (measured,) = calibration.scan.measurements
    error, used = calibration.held_out.error, measured.usable
    if len(error) != int(used.sum()):
        used = np.asarray(used.any(axis=0))[None]
    power = np.full((*used.shape, error.shape[1]), np.nan)
    power[used] = np.abs(error) ** 2
    return power


def _differs(power: Array, axis: int) -> bool:
    """Whether the logarithm of the power differs along an axis beyond chance."""
    from scipy.stats import f_oneway  # loads slowly, and other diagnoses do without

    rows = np.log(np.maximum(np.moveaxis(power, axis, 0), 1e-300)).reshape(power.shape[axis], -1)
    groups = [row[np.isfinite(row)] for row in rows]
    groups = [group for group in groups if group.size > 1]
    return len(groups) > 1 and bool(f_oneway(*groups).pvalue < CHANCE)


def to_document(result: FewPosesDiagnosis) -> dict[str, Any]:
    """Return what was found as plain data, as `sessions.diagnosis.to_document` does.

    Poses are not compared: there are too few of them.
    """
    before, after = rms(result.before.held_out.error), rms(result.after.held_out.error)
    effects = list(map(effect_figures, result.effects, result.without_t))
    depends_on = list(result.depends_on) if result.unexplained else []
    flux_t, none = (before, after, result.floor_t), TrackingErrors()
    return document_of(flux_t, none, none, effects, result.unexplained, depends_on)
