"""The folders that commands write to, and the line that names the files written."""

import os
import sys
from pathlib import Path

from anser_ros.errors import ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.sessions.model_file import SNAPSHOT, is_snapshot


def make_folder(folder: Path) -> None:
    """Make a folder for results before the work begins.

    Raises
    ------
    ParameterError
        When the folder cannot be made, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'no folder {folder}: {error.strerror}') from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ParameterError(f'no permission to write into {folder}')


def say_written(*paths: Path) -> None:
    """Print the paths of the results in one line."""
    print(f'wrote {", ".join(map(str, paths))}')


def warn_of_snapshot(command: str, name: str, model: FieldModel) -> None:
    """Say on stderr that a command works with a snapshot of a refit, where it does."""
    if is_snapshot(model):
        print(f'anser {command}: {name} is a {SNAPSHOT}, no calibration', file=sys.stderr)
