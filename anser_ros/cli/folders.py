"""Makes the folders of results before the work begins, and takes those back that stay empty."""

import contextlib
import itertools
import os
import tempfile
from pathlib import Path

from anser_ros.errors import ParameterError

_made: list[Path] = []
"""Folders that this command has made, parents first."""


def make_folder(folder: Path | None) -> None:
    """Make a folder for results before the work begins, where one is wanted.

    Raises `ParameterError` when the folder cannot be made, or nothing can be written there.
    """
    if folder is None:
        return
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'no folder {folder}: {error.strerror}') from error
    _made.extend(reversed(missing))
    try:  # permissions alone do not tell: a file system may be full, or no place for files
        with tempfile.TemporaryFile(dir=folder) as stream:
            stream.write(b'x')
            stream.flush()
    except OSError as error:
        words = os.strerror(error.errno or 0)
        raise ParameterError(f'nothing can be written into {folder}: {words}') from error


def make_new_folder(parent: Path, stem: str) -> Path:
    """Make and return a folder that was not there; others of the same second get a number.

    Raises `ParameterError` when it cannot be made, or nothing can be written there.
    """
    make_folder(parent)
    for number in itertools.count(1):
        folder = parent / (stem if number == 1 else f'{stem}_{number}')
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            _made.append(folder)
            return folder
    raise AssertionError('the numbers do not end')


def remove_empty_folders() -> None:
    """Remove the folders that were made for results of which there are none."""
    while _made:
        with contextlib.suppress(OSError):  # it has files by now
            _made.pop().rmdir()
