"""Carries a command out: shared options, folders of results, how far it is, and what it has done.

Nothing here needs numpy, so that `doctor` can tell where that is missing.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table

from anser_ros.errors import ParameterError


def add_out(parser: argparse.ArgumentParser, what: str = '', **options: Any) -> None:
    """Declare ``--out``, a folder for what is written; required unless stated otherwise."""
    words = f'folder for {what}, made if missing' if what else 'folder, made if missing'
    parser.add_argument('--out', type=Path, help=words, **{'required': True, **options})


def add_json(parser: argparse.ArgumentParser, what: str) -> None:
    """Declare ``--json``, of which ``what`` says what it prints."""
    parser.add_argument('--json', action='store_true', help=f'print {what}')


def add_list(parser: argparse.ArgumentParser, option: str, **options: Any) -> None:
    """Declare an option that may be repeated; its default is an empty list."""
    parser.add_argument(option, action='append', default=[], **options)


def add_stated_values(parser: argparse.ArgumentParser, *sections: str, idle: str = '') -> None:
    """Declare ``--set``; ``sections`` of `SECTIONS` are those that the command uses."""
    from anser_ros.settings import SECTIONS

    names = [name for section in sections for name in SECTIONS[section] if name != idle]
    words = 'state a value in place of the setup document and the default; may be repeated. Names:'
    words = f'{words} {", ".join(names)}'
    add_list(parser, '--set', dest='stated', metavar='NAME=VALUE', help=words)
    parser.set_defaults(can_state=names)


def stated_values(
    args: argparse.Namespace, idle: Iterable[str] = (), option: str = ''
) -> dict[str, float]:
    """Return the values that the command line states; raises as `parse_entries`.

    Raises `ParameterError` for one that the command does not use, or that is idle without an
    option.
    """
    from anser_ros.settings import parse_entries

    stated = parse_entries(args.stated)
    if useless := stated.keys() - args.can_state:
        raise ParameterError(f'--set {", ".join(sorted(useless))} has no effect on this command')
    if useless := stated.keys() & set(idle):
        raise ParameterError(f'--set {", ".join(sorted(useless))} has no effect without {option}')
    return stated


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


LINE_INTERVAL_S = 5.0
"""Time from one line to the next, s: enough to see that it goes on, few enough for a log."""
LEAST_DONE, LEAST_S = 0.1, 1.0
"""Finished share of a stage, and time that its later half took, s, from which on the time that is
left is shown. Before, it would be that of loading and compiling, which do not come again."""


class Tell(Protocol):
    """Takes what has been reached."""

    def __call__(self, stage: str, share: float | None = None) -> None:
        """Take in the stage and the finished share of it, 0 to 1, where that is known."""


@contextmanager
def progress_of(command: str) -> Iterator[Tell]:
    """Yield a function that takes how far a command is, which a bar or lines then show."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(command)
        return
    columns = (
        TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(),
        TextColumn('{task.fields[left]}'),
    )  # fmt: skip
    with Progress(*columns, console=console) as bar:
        task, shown = bar.add_task(command, total=None, left=''), command
        remaining = _Remaining()

        def tell(stage: str, share: float | None = None) -> None:
            nonlocal shown
            if stage != shown:
                shown = stage
                bar.reset(task, description=stage)
            bar.tasks[0].total = None if share is None else 1.0  # without one the bar only moves
            left = '' if share is None else remaining.words(stage, share)
            bar.update(task, completed=share or 0.0, left=left)

        yield tell


class _Remaining:
    """How long a stage will take, by the pace of the later half of what is finished."""

    def __init__(self) -> None:
        self._stage = ''
        self._past: list[tuple[float, float]] = []

    def words(self, stage: str, share: float) -> str:
        """Take in how far a stage is; the time that is left, empty while it is not known well."""
        now_s = time.monotonic()
        if stage != self._stage:
            self._stage, self._past = stage, []
        if not self._past or share > self._past[-1][0]:
            self._past.append((share, now_s))
        early = (one for one in reversed(self._past) if one[0] <= 0.5 * share)
        done, since_s = next(early, self._past[0])
        took_s = now_s - since_s
        if share < LEAST_DONE or took_s < LEAST_S or share <= done:
            return ''
        return f'about {took_s * (1.0 - share) / (share - done):.0f} s left'


def _lines(command: str) -> Tell:
    """What says a line on stderr every few seconds; of a short command it says nothing."""
    remaining, begin_s = _Remaining(), time.monotonic()
    shown_s = begin_s

    def tell(stage: str, share: float | None = None) -> None:
        nonlocal shown_s
        now_s = time.monotonic()
        if share is None:
            past_s, words = now_s - begin_s, f'after {now_s - begin_s:.0f} s'
        else:
            left = remaining.words(stage, share)
            past_s, words = now_s - shown_s, ', '.join(filter(None, (f'{share:.0%}', left)))
        if past_s >= LINE_INTERVAL_S:
            shown_s = shown_s if share is None else now_s
            print(f'{command}: {stage}, {words}', file=sys.stderr, flush=True)

    return tell


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
    """Holds what a command has found out, and how it says so."""

    document: dict[str, Any]  # what ``--json`` prints
    notes: tuple[str, ...] = ()  # what users have to know of the session or the model, a line each
    shown: tuple[Any, ...] = ()  # tables and texts for the reader of the terminal
    written: tuple[Path, ...] = ()  # the files to look at
    code: int = 0  # the exit code


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
            from anser_ros.cli.page import save

            save(content, written[-1])
    return tuple(written)


def number(value: float | None, scale: float = 1.0, form: str = '.3f') -> str:
    """Return a figure in another unit as text; a dash where there is none."""
    return '-' if value is None or math.isnan(value) else f'{scale * value:{form}}'


def terminal_table(head: Sequence[str], rows: Iterable[Sequence[str]], **style: Any) -> Table:
    shown = Table(*head, **style)
    for row in rows:
        shown.add_row(*row)
    return shown


def loss_notes(*sessions: Any, said: str = '') -> tuple[str, ...]:
    """State what recordings have lost, where they have; None is left out, and what was said."""
    told = ((one.path, one.lost.split('; ')) for one in sessions if one is not None and one.lost)
    new = ((path, '; '.join(w for w in words if w not in said)) for path, words in told)
    return tuple(f'{path}: {words}' for path, words in new if words)
