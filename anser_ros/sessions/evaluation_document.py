"""Writes the document that an evaluation leaves, as `docs/interfaces.md` promises it."""

from typing import Any

from anser_ros.fingerprint import fingerprint_of
from anser_ros.sessions.evaluation import Evaluation
from anser_ros.sessions.pose_errors import metrics
from anser_ros.sessions.session import Session

SCHEMA = 'anser_evaluation/1'
"""Name of the document's layout, which stands in every such document."""


def recording_of(session: Session) -> str:
    """Return the fingerprint of what was recorded, whatever the file is called."""
    return fingerprint_of([tool.flux[:, :1] for tool in session.tools])


def to_document(evaluation: Evaluation) -> dict[str, Any]:
    """Return the figures of every sensor and body as plain data.

    Where the model followed the references, the number of frames in each state of the refit, and
    in how many each reference sensor was left out, are there too.
    """
    document: dict[str, Any] = {'schema': SCHEMA}
    for kind, group in evaluation.groups.items():
        document[kind] = {name: metrics(series) for name, series in group.items()}
    if evaluation.refit is not None:
        document['refit'] = {
            'states': dict(evaluation.refit.states),
            'left_out': dict(evaluation.refit.left_out),
        }
    return document
