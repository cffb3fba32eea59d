"""Reads field models from files and writes them."""

import os
from dataclasses import replace

import numpy as np

from anser_ros.errors import ModelFileError
from anser_ros.field.model import FieldModel, from_document, to_document
from anser_ros.wire.model_file import read_document, write_document

SNAPSHOT = 'snapshot of a refit with metal in force'
"""Source of a model that was saved while it held more than the one it started from."""


def load_model(path: str | os.PathLike[str], snapshot: bool = False) -> FieldModel:
    """Read a model file; a snapshot of a refit, which is no calibration, only if it is wanted.

    Raises
    ------
    ModelFileError
        With the file's name and the rule that it breaks.
    """
    try:
        model = from_document(read_document(path))
        if is_snapshot(model) and not snapshot:
            raise ModelFileError(
                f'a {SNAPSHOT} (stamp_ns {model.provenance.get("stamp_ns")}) is not a '
                'calibration; load the model that the refit started from'
            )
    except ModelFileError as error:
        text = str(error)
        raise ModelFileError(
            text if text.startswith(os.fspath(path)) else f'{path}: {text}'
        ) from error
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
