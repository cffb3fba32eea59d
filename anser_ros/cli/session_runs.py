"""Runs one command on each of several sessions: what is done with one, and what it left.

Each session has its own folder; one that fails has an outcome like the others.
"""

import argparse
import contextlib
import importlib
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from anser_ros.cli.commands import OFFLINE
from anser_ros.cli.folders import make_folder
from anser_ros.cli.main import EXIT_BAD_INPUT, EXIT_DEFECT, EXIT_OK, attempt
from anser_ros.cli.output import Result
from anser_ros.cli.summary import SCHEMA, Outcome, row_of, table_of, write_summary
from anser_ros.errors import ParameterError
from anser_ros.parallel import shared_among

ALONE = threading.Lock()
"""One session at a time in a process: drawing, the working folder and the threads are shared."""


@dataclass(frozen=True)
class SessionRun:
    """A command to run on one session, by the arguments that its ``work`` takes."""

    command: str  # calibrate, diagnose or evaluate
    name: str  # the session's in the summary, and of its folder
    session: str  # the bag
    args: argparse.Namespace
    folder: str  # from which the paths in the arguments hold


def runs_of(command: str, args: argparse.Namespace) -> list[SessionRun]:
    """Return the runs of a command on all sessions of its arguments, each into its own folder."""
    runs = []
    for session, name in zip(args.sessions, names_of(args.sessions), strict=True):
        own = argparse.Namespace(**{**vars(args), 'session': session, 'sessions': [session]})
        own.out = args.out / name
        if command == 'calibrate':
            own.out, own.report = own.out / 'model.yaml', own.out
        runs.append(SessionRun(command, name, session, own, os.getcwd()))
    return runs


def names_of(sessions: Sequence[str]) -> list[str]:
    """Return names for sessions by their paths: as many last parts as distinguish them.

    Raises `ParameterError` when a session is given twice.
    """
    paths = [Path(session).resolve() for session in sessions]
    for place, path in enumerate(paths):
        if path in paths[:place]:
            raise ParameterError(f'{sessions[place]} is given twice')
    parts = [(*path.parts[1:-1], path.name if path.is_dir() else path.stem) for path in paths]
    names = []
    for own in parts:
        count = 1
        while sum(other[-count:] == own[-count:] for other in parts) > 1 and count < len(own):
            count += 1
        names.append('-'.join(own[-count:]))
    doubled = {name for name in names if names.count(name) > 1}
    return [
        path.name if name in doubled else name for name, path in zip(names, paths, strict=True)
    ]


def perform(run: SessionRun, threads: int | None = None) -> Outcome:
    """Do a run in this process, whatever comes of it.

    It may share its work among as many threads as are stated, by default as its caller.
    """
    module = importlib.import_module(OFFLINE[run.command][0])

    def work() -> Result:
        sharing = contextlib.nullcontext() if threads is None else shared_among(threads)
        with contextlib.chdir(run.folder), sharing:
            done: Result = module.work(run.args, lambda *_: None)
            return done

    with ALONE:
        began_s = time.monotonic()
        code, result, words = attempt(work)
        seconds = time.monotonic() - began_s
    if result is not None:
        notes = '; '.join(result.notes)
        return Outcome(run.name, run.session, code, result.document, notes, '', seconds)
    trace = words if code == EXIT_DEFECT else ''
    line = f'a defect of the program: {words.splitlines()[-1]}' if trace else words
    return Outcome(run.name, run.session, code, {}, line, trace, seconds)


def summed_up(command: str, outcomes: Sequence[Outcome], folder: Path) -> Result:
    """Write the summary of all runs of a command into a folder.

    The exit code is 0 where all went well, 1 where there was a defect of the program, else 2.
    """
    rows = [row_of(command, outcome) for outcome in outcomes]
    make_folder(folder)
    written = write_summary(folder, command, rows)
    failed = [outcome for outcome in outcomes if outcome.code != EXIT_OK]
    notes = [f'{one.session}:\n{one.traceback}' for one in failed if one.traceback]
    notes += [f'{one.name}: {one.words}' for one in failed]
    if failed:
        notes.append(f'{len(failed)} of {len(outcomes)} sessions failed')
    return Result(
        {'schema': SCHEMA, 'command': command, 'sessions': rows},
        tuple(notes),
        (table_of(command, rows),),
        written,
        EXIT_DEFECT
        if EXIT_DEFECT in [one.code for one in failed]
        else EXIT_BAD_INPUT
        if failed
        else EXIT_OK,
    )
