"""Field models read from files and written to them."""

import os

from anser_ros.errors import ModelFileError
from anser_ros.field.model import FieldModel, from_document, to_document
from anser_ros.wire.model_file import read_document, write_document


def load_model(path: str | os.PathLike[str]) -> FieldModel:
    """Read a model file; raises `ModelFileError` with the file's name and the rule."""
    try:
        return from_document(read_document(path))
    except ModelFileError as error:
        text = str(error)
        raise ModelFileError(
            text if text.startswith(os.fspath(path)) else f'{path}: {text}'
        ) from error


def save_model(path: str | os.PathLike[str], model: FieldModel) -> None:
    """Write a model file whole or not at all; raises `ModelFileError`."""
    write_document(path, to_document(model))
