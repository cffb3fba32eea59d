"""Checks folders that commands write to, and says what a command has done."""

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from anser_ros.cli.folders import make_folder
from anser_ros.errors import ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.sessions.model_file import SNAPSHOT, is_snapshot


def check_file(path: Path) -> None:
    """Make the folder of a file that is written at the end, before the work begins.

    Raises
    ------
    ParameterError
        When the folder cannot be made, or the file cannot be written.
    """
    make_folder(path.parent)
    if path.is_dir():
        raise ParameterError(f'{path} is a folder, but must be a file')
    if path.exists() and not os.access(path, os.W_OK):
        raise ParameterError(f'no permission to write {path}')


def check_new_file(path: Path) -> None:
    """Check as `check_file` does a file that must not be there yet, as a bag must not."""
    if path.exists():
        raise ParameterError(f'{path}: already exists')
    make_folder(path.parent)


@dataclass(frozen=True)
class Result:
    """Holds what a command has found out about a session, and how it says so.

    Attributes
    ----------
    document : dict
        The content of its JSON file.
    notes : tuple of str
        What users have to know of the session or the model, a line each.
    shown : tuple
        Tables and texts for the reader of the terminal.
    written : tuple of Path
        The files to look at.
    """

    document: dict[str, Any]
    notes: tuple[str, ...]
    shown: tuple[Any, ...]
    written: tuple[Path, ...]


def say(command: str, result: Result, *, as_json: bool) -> None:
    """Print the notes on stderr, and on stdout the document alone or all that is shown."""
    for note in result.notes:
        print(f'anser {command}: {note}', file=sys.stderr)
    if as_json:
        print(json.dumps(result.document, indent=1))
        return
    for item in result.shown:
        if isinstance(item, str):
            print(item)
        else:
            Console().print(item)
    say_written(*result.written)


def say_written(*paths: Path) -> None:
    """Print the paths of the results in one line."""
    print(f'wrote {", ".join(map(str, paths))}')


def snapshot_notes(name: str, model: FieldModel) -> tuple[str, ...]:
    """Report that a command works with a snapshot of a refit, where it does."""
    return (f'{name} is a {SNAPSHOT}, not a calibration',) if is_snapshot(model) else ()


def loss_notes(session: str, lost: str) -> tuple[str, ...]:
    """State what a session has lost, where it has."""
    return (f'{session}: {lost}',) if lost else ()
