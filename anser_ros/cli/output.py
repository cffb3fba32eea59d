"""The folders that commands write to, and the line that names the files written."""

import os
from pathlib import Path

from anser_ros.errors import ParameterError


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
