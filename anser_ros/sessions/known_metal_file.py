"""Reads known metal from files and writes it."""

import os

from anser_ros.errors import ModelFileError
from anser_ros.known_metal.known import KnownMetal, from_document, to_document
from anser_ros.wire.model_file import read_document, write_document


def load_known_metal(path: str | os.PathLike[str]) -> KnownMetal:
    """Read a file of metal that was learnt.

    Raises
    ------
    ModelFileError
        With the file's name and what is wrong.
    """
    document = read_document(path)
    try:
        return from_document(document)
    except ModelFileError as error:
        raise ModelFileError(f'{os.fspath(path)}: {error}') from error


def save_known_metal(path: str | os.PathLike[str], known: KnownMetal) -> None:
    """Write a file of metal that was learnt whole or not at all; raises `ModelFileError`."""
    write_document(path, to_document(known))
