"""Reads, writes and chooses the model that a command starts from, and checks what it is of."""

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anser_ros.effects.correction import drifts
from anser_ros.effects.effect import Remedy, effect_named
from anser_ros.errors import ModelFileError
from anser_ros.field.model import FieldModel, from_document, to_document
from anser_ros.field.nominal import nominal_model
from anser_ros.fingerprint import Identity
from anser_ros.sessions.nominal_board import board_of
from anser_ros.sessions.plausibility import silent
from anser_ros.sessions.session import Session
from anser_ros.wire.setup import Setup
from anser_ros.wire.text_files import NOMINAL, read_document, write_document

SNAPSHOT = 'snapshot of a refit with metal in force'
"""Source of a model that was saved while it held more than the one it started from."""


def load_model(path: str | os.PathLike[str], snapshot: bool = False) -> FieldModel:
    """Read a model file, a refit's snapshot only if wanted; raises `ModelFileError`."""
    document = read_document(path)
    try:
        model = from_document(document)
        if is_snapshot(model) and not snapshot:
            raise ModelFileError(
                f'a {SNAPSHOT} (stamp_ns {model.provenance.get("stamp_ns")}) is not a '
                'calibration; load the model that the refit started from'
            )
    except ModelFileError as error:
        raise ModelFileError(f'{path}: {error}') from error
    return model


def save_model(path: str | os.PathLike[str], model: FieldModel) -> None:
    """Write a model file whole or not at all; raises `ModelFileError`."""
    write_document(path, to_document(model))


def is_snapshot(model: FieldModel) -> bool:
    """Return whether a model, or one it was made from, was saved with a refit's change in it."""
    return model.provenance.get('source') == SNAPSHOT


def as_saved(model: FieldModel, base: FieldModel, stamp_ns: int) -> FieldModel:
    """Return a model as it is written, active since a stamp: with its source, if not the base.

    The base is the one that the refit started from.
    """
    parts = ('positions', 'directions', 'moments')
    if all(np.array_equal(getattr(model, part), getattr(base, part)) for part in parts):
        return model
    provenance = {
        'source': SNAPSHOT, 'stamp_ns': stamp_ns, 'started_from': dict(base.provenance)
    }  # fmt: skip
    return replace(model, provenance=provenance)


def starting_model(setup: Setup, given: FieldModel | None) -> FieldModel:
    """Return the given or nominal model to start from; raises `ModelFileError`, `SetupError`."""
    if given is None:
        return nominal_model(board_of(setup))
    check_emitters(setup, given)
    return given


def check_emitters(setup: Setup, given: FieldModel, where: str = 'the setup') -> None:
    """Raise `ModelFileError` when a model's emitters are not the setup's, or it is of another."""
    if given.emitters != setup.emitter_names:
        raise ModelFileError(
            f'the model has the emitters {", ".join(given.emitters)}; '
            f'{where} has {", ".join(setup.emitter_names)}'
        )
    check_made_for(given, setup, where)


def model_for(
    name: str, session: Session, snapshot: bool = False, resurveyed: Sequence[str] = ()
) -> FieldModel:
    """Return the model that ``name`` stands for: a file's path, or ``nominal``.

    ``snapshot`` is whether a snapshot of a refit, which is no calibration, is accepted, and
    ``resurveyed`` names bodies whose sensors are the same, surveyed again. Raises `ModelFileError`
    when the file is no such model, or not of the session's emitters; `SetupError` when the setup's
    geometry makes no nominal one.
    """
    if name == NOMINAL:
        if resurveyed:
            raise ModelFileError('--resurveyed has no effect with the nominal model')
        return nominal_model(board_of(session.setup))
    model = with_new_survey(load_model(name, snapshot), session.setup, resurveyed)
    check_fits(model, session)
    return model


def is_nominal(model: FieldModel) -> bool:
    """Return whether a model is a nominal one, or was made from it without a calibration."""
    return model.provenance.get('source') == NOMINAL


def made_for(model: FieldModel, setup: Setup) -> FieldModel:
    """Return the model as one for a setup: its board, and its bodies beside those from before."""
    before = {} if model.made_for is None else model.made_for.bodies
    identity = setup.identity
    return replace(model, made_for=Identity(identity.board, {**before, **identity.bodies}))


def with_new_survey(model: FieldModel, setup: Setup, bodies: Sequence[str]) -> FieldModel:
    """Return the model for bodies whose sensors are the same, but surveyed again.

    Its corrections of channels, such as their gains, still hold; those of the old survey's places
    and axes are removed. Raises `ModelFileError` when the setup has no such body, or the model
    does not state what it was made for.
    """
    made, kept = model.made_for, model.effects
    for body in bodies:
        if body not in setup.identity.bodies:
            raise ModelFileError(f'no body {body} in the setup to be surveyed again')
        if made is None:
            raise ModelFileError(
                f'the model {model.fingerprint} does not state what it was made for'
            )
        made = Identity(made.board, {**made.bodies, body: setup.identity.bodies[body]})
        kept = tuple(
            effect for effect in kept
            if not (
                effect_named(effect.name).remedy is Remedy.SENSORS
                and body in _bodies_of(replace(model, effects=(effect,)), setup)
            )
        )  # fmt: skip
    return replace(model, made_for=made, effects=kept)


def check_made_for(model: FieldModel, setup: Setup, where: str) -> None:
    """Raise `ModelFileError` when a model is of another board, or its effects of other sensors.

    A tool that the model does not mention may be another one than it was calibrated with. A model
    that does not state what it was made for passes.
    """
    made, now = model.made_for, setup.identity
    if made is None:
        return
    if made.board != now.board:
        raise ModelFileError(
            f'the model {model.fingerprint} was made for the board {made.board}; {where} has '
            f'the board {now.board}'
        )
    for body in sorted(_bodies_of(model, setup)):
        known = made.bodies.get(body)
        if known is not None and known != now.bodies[body]:
            raise ModelFileError(
                f'effects of the model {model.fingerprint} are of the sensors {known} on {body}; '
                f'{where} has {now.bodies[body]} there, with other places, axes or channels: '
                f'calibrate with these, or state what holds (--resurveyed {body} in a command)'
            )


def _bodies_of(model: FieldModel, setup: Setup) -> set[str]:
    """Bodies of the setup whose sensors an effect of the model names."""
    found = set()
    for effect in model.effects:
        named, body = effect.channels, effect.parameters.get('body')
        found |= {s.body for s in setup.sensors if s.channel in named or s.body == body}
    return found


def check_fits(model: FieldModel, session: Session) -> None:
    """Raise `ModelFileError` when a model is not of a session's emitters, or lacks one of them.

    See `check_made_for`.
    """
    ours, theirs = model.frequencies_hz, session.setup.frequencies_hz
    if len(ours) == len(theirs) and not np.allclose(ours, theirs, rtol=1e-3):
        raise ModelFileError(
            f'the model drives at {list(ours)} Hz; the session {session.path} at {list(theirs)} Hz'
        )
    check_emitters(session.setup, model, f'the session {session.path}')
    size, dead = np.abs(model.moments).max(axis=0), silent(session.setup, session.tools)
    for name in np.array(model.emitters)[size < NO_FIELD * size.max()].tolist():
        if session.tools and dead.get(name) != '':
            words = 'was it dead in the calibration?'
            raise ModelFileError(f'the model has no field of {name}, {session.path} has: {words}')


NO_FIELD = 1e-3
"""Largest moment of an emitter, over that of all, below which a model was made while it was dead:
coils of a board are alike, and noise over a scan makes a ten thousandth."""
FOUND_ON = 'session_start_ns'
"""Key in a drift's evidence: the first stamp, ns, of the session on which it took its course."""


def date_drifts(model: FieldModel, session: Session) -> FieldModel:
    """Return the model, its drifts without a date dated by the session they were found on."""
    effects = tuple(
        replace(effect, evidence={**effect.evidence, FOUND_ON: session.start_ns})
        if drifts(effect) and FOUND_ON not in effect.evidence
        else effect
        for effect in model.effects
    )
    return replace(model, effects=effects)


def is_recorded(model: FieldModel, session: Session) -> bool:
    """Return whether this is the session on which one of the model's drifts was found."""
    found = [effect.evidence.get(FOUND_ON) for effect in model.effects if drifts(effect)]
    return session.start_ns in found
