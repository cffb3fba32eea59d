"""Dates drifts of emitters, whose course holds only on the session that they were found on.

A diagnosis notes that session in the drift's evidence, by its first stamp, so that a later
evaluation can determine whether it tracks the same session.
"""

from dataclasses import replace

from anser_ros.effects.correction import drifts
from anser_ros.field.model import FieldModel
from anser_ros.sessions.session import Session

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
