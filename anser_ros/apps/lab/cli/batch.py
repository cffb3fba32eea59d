"""Runs one command on many sessions with Dask: on this machine's cores, or on a cluster.

A worker runs the code of the command itself, one session at a time. The scheduler gives the
session of a worker that dies to another one. A session's results are in its folder and in the
summary, which is rewritten whenever one is done.
"""

import argparse
import contextlib
import importlib
import logging
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from anser_ros.cli.commands import OFFLINE
from anser_ros.cli.main import EXIT_BAD_INPUT, EXIT_DEFECT, attempt
from anser_ros.cli.output import Result, Tell, add_json, add_out, make_folder
from anser_ros.cli.sessions import (
    COMMANDS,
    Outcome,
    SessionRun,
    perform,
    row_of,
    runs_of,
    summed_up,
    write_summary,
)
from anser_ros.errors import ParameterError
from anser_ros.parallel import ONE_THREAD, cores

if TYPE_CHECKING:  # Dask is loaded where it is used: the help is there without it
    from distributed import Client

CONNECT_S = 10.0
"""How long a scheduler is waited for, s: one that runs answers at once."""
WORKERS = {
    # Dask has glibc give freed memory back at once, and a thread look every 10 ms at what the
    # others do: with arrays of a few hundred kB that doubles and triples the time of a session.
    'distributed.nanny.pre-spawn-environ': dict.fromkeys(ONE_THREAD, '1'),
    'distributed.worker.profile.enabled': False,
}
"""Settings of Dask for the workers on this machine."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser batch evaluate bags/moving.mcap bags/metal.mcap '
        '--model config/demo_model.yaml --out results/ (made if missing)'
    )
    verbs = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name in COMMANDS:
        module, words = OFFLINE[name]
        model = '' if name == 'calibrate' else '--model config/demo_model.yaml '
        verb = verbs.add_parser(
            name, help=f'{words}, each session by itself',
            description=f'anser {name} on each session by itself',
            epilog=f'example: anser batch {name} bags/*.mcap {model}--out results/',
        )  # fmt: skip
        verb.add_argument('sessions', nargs='+', metavar='BAG', help='.mcap files or bag folders')
        add_out(verb, 'summary.csv, summary.html and one folder per session')
        where = verb.add_mutually_exclusive_group()
        where.add_argument(
            '--scheduler', metavar='ADDRESS',
            help='Dask scheduler whose workers see the same folders and have this package, e.g. '
            'tcp://10.0.0.5:8786; by default workers on this machine',
        )  # fmt: skip
        where.add_argument(
            '--workers', type=int, default=cores(), metavar='N',
            help='processes on this machine, by default one per core',
        )  # fmt: skip
        importlib.import_module(module).add_options(verb)
        add_json(verb, 'the summary on stdout')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Run the command of the arguments on all sessions."""
    if args.workers < 1:
        raise ParameterError(f'--workers must be at least 1, got {args.workers}')
    runs = runs_of(args.command, args)
    make_folder(args.out)
    found: dict[str, Outcome] = {}
    with _client(args, len(runs)) as (client, threads):
        sessions = f'{len(runs)} sessions'
        tell(sessions, 0.0)
        for outcome in _outcomes(client, runs, threads):
            found[outcome.name] = outcome
            done = [found[one.name] for one in runs if one.name in found]
            write_summary(args.out, args.command, [row_of(args.command, one) for one in done])
            tell(sessions, len(done) / len(runs))
    return summed_up(args.command, [found[one.name] for one in runs], args.out)


@contextlib.contextmanager
def _client(args: argparse.Namespace, sessions: int) -> Iterator[tuple['Client', int]]:
    """A client of the scheduler, and the threads among which a session may share its work."""
    import dask
    from distributed import Client, LocalCluster

    if args.scheduler is not None:
        try:
            client = Client(args.scheduler, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise ParameterError(f'no Dask scheduler at {args.scheduler}: {error}') from error
        with client:
            yield client, 1
        return
    workers = min(args.workers, sessions)
    # Silent: what becomes of a session stands in its row.
    options = {'dashboard_address': '127.0.0.1:0', 'silence_logs': logging.CRITICAL}
    with (
        dask.config.set(WORKERS),
        LocalCluster(n_workers=workers, threads_per_worker=1, **options) as cluster,
        Client(cluster) as client,
    ):
        yield client, max(1, cores() // workers)


def _outcomes(client: 'Client', runs: Sequence[SessionRun], threads: int) -> Iterator[Outcome]:
    """What became of each run, as they end."""
    from distributed import as_completed

    futures = client.map(perform, runs, threads=threads, pure=False)
    of = dict(zip(futures, runs, strict=True))
    for future in as_completed(futures):
        code, outcome, words = attempt(future.result)
        if outcome is None:
            outcome = _lost(of[future], future.exception(), code, words)
        yield outcome


def _lost(run: SessionRun, error: Any, code: int, words: str) -> Outcome:
    """A session that no worker could bring to an end."""
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        line = 'every worker that ran it died, possibly for lack of memory'
        return Outcome(run.name, run.session, EXIT_BAD_INPUT, {}, line)
    trace = words if code == EXIT_DEFECT else ''
    return Outcome(run.name, run.session, code, {}, words.splitlines()[-1], trace)
