"""Works out once what follows from a session and a model, after checking that they fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.calibration.readings import with_pose
from anser_ros.calibration.result import residuals
from anser_ros.effects.correction import Correction, coils_read
from anser_ros.effects.effect import Term, effect_named
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import SESSION, FieldModel
from anser_ros.physics.rotations import rotation_of_vector
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.sessions.baseline import Baseline, clean_flux
from anser_ros.sessions.nominal_board import NominalBoard, tracked_volume
from anser_ros.sessions.plausibility import check_unit
from anser_ros.sessions.session import Session, measured_noise
from anser_ros.sessions.starting_model import check_fits, is_recorded


@dataclass(frozen=True)
class PreparedSession:
    """Holds a session and a model that fits it, with what follows from the two.

    ``noise_t`` is the noise of the fluxes' components as the acquisition measured it; 0 where it
    did not, and where the setup states it. Poses are accepted in the volume. The baseline is of
    the reference sensors, the correction undoes the effects that the model knows, and
    ``recorded_drift`` says whether the model's drifts took their course on this very session.
    """

    session: Session
    model: FieldModel
    nominal: NominalBoard
    noise_t: float
    volume: TrackedVolume
    baseline: Baseline | None
    correction: Correction
    recorded_drift: bool

    @property
    def sensors(self) -> SensorTable:
        """Return all tool sensors, one body after the other, as the setup has them."""
        return self.session.sensors

    def with_session(self, session: Session) -> 'PreparedSession':
        """Return the same for a part of the session, or another recording of its setup."""
        return replace(self, session=session, recorded_drift=is_recorded(self.model, session))

    def with_model(self, model: FieldModel) -> 'PreparedSession':
        """Return the same with another model; raises `ModelFileError` when it does not fit."""
        check_fits(model, self.session)
        correction, recorded = _correction(model, self.session), is_recorded(model, self.session)
        return replace(self, model=model, correction=correction, recorded_drift=recorded)


def prepare(
    session: Session, model: FieldModel, baseline: Session | None = None
) -> PreparedSession:
    """Check a model against a session, and work out what follows from the two.

    A baseline's readings are not used where the session has no reference fluxes. Raises
    `ModelFileError` when the model's emitters are not the session's or the baseline's, or an
    effect of it is unknown; `PlausibilityError` when fluxes are in another unit than the model's;
    `BagError` when the baseline's references are not the session's, or there is metal in it.
    """
    check_fits(model, session)
    for tool in session.tools:
        check_unit(session.path, model, tool, session.setup.accuracy.flux_noise_t)
    model = as_it_stood(model, session)
    clean = None
    if baseline is not None:
        check_fits(model, baseline)
        if session.reference is not None:
            flux = clean_flux(baseline, session.reference.sensors, model)
            clean = Baseline(baseline.path, flux)
    setup, volume = session.setup, tracked_volume(session.setup)
    return PreparedSession(
        session, model, NominalBoard.of(setup), measured_noise(setup), volume, clean,
        _correction(model, session), is_recorded(model, session),
    )  # fmt: skip


def each_stand(model: FieldModel) -> list[FieldModel]:
    """Return a model of several sessions as it was in each, where it knows a difference."""
    names = dict.fromkeys(filter(None, (e.parameters.get(SESSION) for e in model.effects)))
    return [_stood(model, name) for name in names]


def as_it_stood(model: FieldModel, session: Session) -> FieldModel:
    """Return a model of several sessions in the frame of the one that a session stands like.

    That one leaves least of the fluxes at the session's poses. Without any, and where the model
    knows no such difference, it stands in between, as it was written.
    """
    tools = [tool for tool in map(with_pose, session.tools) if len(tool.time)]
    if not tools:
        return model

    def left(one: FieldModel) -> float:
        how = _correction(one, session), is_recorded(one, session)
        return residuals([_corrected(*how, tool) for tool in tools], one).unexplained

    return min(each_stand(model), key=left, default=model)


def _stood(model: FieldModel, name: str) -> FieldModel:
    """A model as it was in one of its sessions."""
    effects = []
    for effect in model.effects:
        given = dict(effect.parameters)
        if given.pop(SESSION, name) != name:
            continue
        if SESSION in effect.parameters and effect_named(effect.name).is_frame:
            turn = rotation_of_vector(np.radians(given['rotation_deg']))
            model = model.turned(turn, np.array(given['translation_m']))
        else:
            effects.append(replace(effect, parameters=given))
    return replace(model, effects=tuple(effects))


def _correction(model: FieldModel, session: Session) -> Correction:
    return Correction.of(model.effects, session.sensors, model.frequencies_hz)


def correct(prepared: PreparedSession, plugs: Sequence[Term] = ()) -> PreparedSession:
    """Return the session as the effects that the model knows already leave it.

    Fluxes are those that ideal sensors and emitters would have given, sensors are where they
    truly are, and optical poses are on the fluxes' clock and in the frame fg. ``plugs``: what is
    exchanged in this session; it stays so.
    """
    session = prepared.session
    how = prepared.correction, prepared.recorded_drift
    tools = tuple(_corrected(*how, tool, plugs) for tool in session.tools)
    reference = session.reference
    if reference is not None:
        reference = _corrected(*how, reference)
    return prepared.with_session(replace(session, tools=tools, reference=reference))


def _corrected(
    correction: Correction, recorded: bool, measurements: Measurements, plugs: Sequence[Term] = ()
) -> Measurements:
    flux = measurements.flux
    if not correction.terms:
        return measurements
    if correction.changes_flux:
        channels = coils_read(plugs, measurements.sensors.channel)
        rows = zip(measurements.time.tolist(), flux, strict=True)
        flux = np.array(
            [correction.flux(time, channels, frame, recorded=recorded) for time, frame in rows]
        )
    return with_truth(replace(measurements, flux=flux), correction)


def with_truth(measurements: Measurements, correction: Correction) -> Measurements:
    """Return measurements whose sensors and optical poses are as a model's corrections say."""
    out = replace(measurements, sensors=correction.sensors(measurements.sensors))
    return out if out.track is None else out.with_track(correction.optical(out.track))
