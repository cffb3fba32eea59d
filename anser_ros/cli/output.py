"""Says what a command has done: its document or tables, its notes, the files that it wrote.

A command returns a `Result`; `main` shows it. All figures of tables and pages go through `number`.
"""

import json
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from anser_ros.cli.folders import make_folder
from anser_ros.errors import ParameterError


def check_file(path: Path) -> None:
    """Make the folder of a file that is written at the end, before the work begins.

    Raises `ParameterError` when the folder cannot be made, or the file cannot be written.
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
    """Holds what a command has found out, and how it says so.

    Attributes
    ----------
    document : dict
        What ``--json`` prints.
    notes : tuple of str
        What users have to know of the session or the model, a line each.
    shown : tuple
        Tables and texts for the reader of the terminal.
    written : tuple of Path
        The files to look at.
    code : int
        The exit code.
    """

    document: dict[str, Any]
    notes: tuple[str, ...] = ()
    shown: tuple[Any, ...] = ()
    written: tuple[Path, ...] = ()
    code: int = 0


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
    if result.written:
        say_written(*result.written)


def say_written(*paths: Path) -> None:
    """Print the paths of the results in one line."""
    print(f'wrote {", ".join(map(str, paths))}')


def write_files(folder: Path | None, contents: Mapping[str, Any]) -> tuple[Path, ...]:
    """Write documents (as JSON), texts and figures by their names; the paths, none without folder.

    What is None is not written.
    """
    if folder is None:
        return ()
    written = []
    for name, content in contents.items():
        if content is None:
            continue
        written.append(folder / name)
        if isinstance(content, str):
            written[-1].write_text(content, encoding='utf-8')
        elif isinstance(content, dict):
            written[-1].write_text(json.dumps(content, indent=1) + '\n', encoding='utf-8')
        else:
            from anser_ros.pictures import save

            save(content, written[-1])
    return tuple(written)


def number(value: float | None, scale: float = 1.0, form: str = '.3f') -> str:
    """Return a figure in another unit as text; a dash where there is none."""
    return '-' if value is None or math.isnan(value) else f'{scale * value:{form}}'


def terminal_table(head: Sequence[str], rows: Iterable[Sequence[str]], **style: Any) -> Table:
    """Return rows of text as a table for the terminal."""
    shown = Table(*head, **style)
    for row in rows:
        shown.add_row(*row)
    return shown


def loss_notes(session: str, lost: str) -> tuple[str, ...]:
    """State what a session has lost, where it has."""
    return (f'{session}: {lost}',) if lost else ()
