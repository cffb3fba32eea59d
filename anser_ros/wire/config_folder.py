"""Finds the files of `config/`, in a source tree as in an installation."""

from __future__ import annotations

from pathlib import Path

from anser_ros.errors import SetupError
from anser_ros.wire.text_files import read_text

_PACKAGE = 'anser_ros'


def config_path(name: str) -> Path:
    """Return the path of a file: `name` itself where it exists, else the one in `config/`.

    Raises
    ------
    SetupError
        When there is neither.
    """
    given = Path(name).expanduser()
    if given.is_file():
        return given
    if given.name == name:
        for folder in Path(__file__).resolve().parents:
            for candidate in (folder / 'config', folder / 'share' / _PACKAGE / 'config'):
                if (candidate / name).is_file():
                    return candidate / name
    raise SetupError(f'no file {name}, and none of that name among the files of config/')


def read_config(name: str) -> str:
    """Return the text of a file that `config_path` finds.

    Raises
    ------
    SetupError
        When there is none, or it is no text.
    """
    return read_text(config_path(name), SetupError)
