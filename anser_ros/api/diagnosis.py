"""Offers diagnosis as a function: session and model in, named effects and a better model out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from anser_ros.api.given import Figures, Progress, SessionSource, session_given, shown
from anser_ros.api.model import Model, ModelSource, field_given
from anser_ros.sessions.diagnosis import diagnose_session, other_way, to_document


@dataclass(frozen=True)
class DiagnosisResult(Figures):
    """Holds what a model lacks on a session.

    Attributes
    ----------
    model : Model
        The model with the effects found, which `track` and all commands and nodes accept.
    effects : tuple of str
        Names of the effects found; empty for a session that the model explains.
    figures : mapping
        Everything that ``diagnosis.json`` holds: parameters, uncertainties, held-out errors.
    """

    ROWS = 'effects'
    model: Model
    effects: tuple[str, ...]
    figures: Mapping[str, Any]

    def __repr__(self) -> str:
        return f'DiagnosisResult({", ".join(self.effects) or "no effect"}; {self.model})'


def diagnose(
    session: SessionSource,
    model: ModelSource,
    *,
    baseline: SessionSource | None = None,
    progress: Progress = None,
) -> DiagnosisResult:
    """Find what a model lacks on a session, name the effects, and correct them.

    Parameters
    ----------
    session : Session or path
        With optical poses of at least one tool.
    model : Model or path
        ``nominal`` is the board as the session's setup draws it.
    baseline : Session or path, optional
        Distortion-free recording of the same board; with it the reference sensors are used.
    progress : bool or callable, optional
        True shows the stage; a function is called with it in words.

    Raises
    ------
    DiagnosisError
        When fewer than 30 frames have fluxes and a pose; fewer poses of a body of many sensors
        are enough where the emitters are of unknown geometry.
    ModelFileError
        When the model's emitters are not the session's.
    PlausibilityError
        When the optical poses are in another frame, unit or order of axes, or delayed.
    BagError
        When the baseline's references are not the session's.

    Examples
    --------
    A session that the model explains:

    >>> from anser_ros import Model, diagnose, load_session
    >>> session = load_session('bags/moving.mcap')
    >>> found = diagnose(session, Model.load('config/demo_model.yaml'))
    >>> found.effects
    ()
    """
    recorded = session_given(session)
    field = field_given(model, recorded.setup)
    clean = None if baseline is None else session_given(baseline)
    with shown(progress, 'diagnose') as tell:
        if way := other_way(recorded, clean):
            other = way.diagnose(recorded, field, tell)
            corrected, figures = other.model, way.to_document(other)
        else:
            found = diagnose_session(recorded, field, clean, tell)
            corrected, figures = found.diagnosis.model, to_document(found)
    names = tuple(effect['name'] for effect in figures['effects'])
    return DiagnosisResult(Model(corrected), names, figures)
