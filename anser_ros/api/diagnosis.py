"""Offers diagnosis as a function: session and model in, named effects and a better model out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from anser_ros.api.model import Model
from anser_ros.sessions.diagnosis import diagnose_session, other_way, to_document
from anser_ros.sessions.session import Session


@dataclass(frozen=True)
class DiagnosisResult:
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

    model: Model
    effects: tuple[str, ...]
    figures: Mapping[str, Any]

    def __repr__(self) -> str:
        return f'DiagnosisResult({", ".join(self.effects) or "no effect"}; {self.model})'

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``diagnosis.json`` (``docs/interfaces.md``)."""
        return dict(self.figures)


def diagnose(
    session: Session,
    model: Model,
    *,
    baseline: Session | None = None,
    progress: Callable[[str], None] | None = None,
) -> DiagnosisResult:
    """Find what a model lacks on a session, name the effects, and correct them.

    Parameters
    ----------
    session : Session
        With optical poses of at least one tool.
    model : Model
    baseline : Session, optional
        Distortion-free recording of the same board; with it the reference sensors are used.
    progress : callable, optional
        Called with the stage in words.

    Raises
    ------
    DiagnosisError
        When fewer than 30 frames have fluxes and a pose; fewer poses of a body of many sensors
        are enough where the emitters are of unknown geometry.
    ModelFileError
        When the model's emitters are not the session's.
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
    if way := other_way(session):
        other = way.diagnose(session, model.field, progress)
        corrected, figures = other.model, way.to_document(other)
    else:
        found = diagnose_session(session, model.field, baseline, progress)
        corrected, figures = found.diagnosis.model, to_document(found)
    names = tuple(effect['name'] for effect in figures['effects'])
    return DiagnosisResult(Model(corrected), names, figures)
