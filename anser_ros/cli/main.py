"""Runs the console script `anser` with one verb per command; each is also a ROS executable.

A node is started by exec of its own module, so that this layer never loads rclpy; an offline
command is imported only when it is the one asked for. `commands` lists both. What needs a package
that is not installed, ROS among them, says so in a line.
"""

import argparse
import contextlib
import importlib
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

from anser_ros import extensions
from anser_ros.cli.commands import COMPOSED, NODES, OFFLINE
from anser_ros.errors import AnserError, OneLineParser
from anser_ros.parallel import ONE_THREAD, cores, prepare_process, shared_among

# Exit codes, as docs/interfaces.md has them.
EXIT_OK = 0  # done
EXIT_DEFECT = 1  # an error of this program
EXIT_BAD_INPUT = 2  # an error of the caller
# The folder anser_ros, whose parent must be on a node's search path.
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb with its arguments, by default those of the process; return the exit code."""
    for variable in ONE_THREAD:  # before anything imports numpy
        os.environ.setdefault(variable, '1')
    for stream in (sys.stdout, sys.stderr):  # a terminal may not know every letter
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='replace')
    try:
        code = _dispatch(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output has closed it
        sys.stdout = open(os.devnull, 'w', encoding='utf-8')  # noqa: SIM115 - until the exit
        return EXIT_OK
    return code


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ('-h', '--help'):
        print(_usage())
        return EXIT_OK if arguments else EXIT_BAD_INPUT
    if arguments[0] == '--version':
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f'anser_ros {version("anser_ros")}')
        except PackageNotFoundError:
            print('anser_ros, not installed')
        return EXIT_OK
    name, rest = arguments[0].replace('-', '_'), arguments[1:]
    if name in NODES or name in COMPOSED:
        try:
            check_packages(name)
        except AnserError as error:
            print(f'anser {name}: {_one_line(error)}', file=sys.stderr)
            return EXIT_BAD_INPUT
        exec_node(name, rest)
    if name in OFFLINE:
        return run_verb(name, rest)
    known = ', '.join([*NODES, *COMPOSED, *OFFLINE])
    print(f'anser: no command {arguments[0]!r}; there are: {known}', file=sys.stderr)
    return EXIT_BAD_INPUT


def run_executable() -> int:
    """Run the verb that the executable is named after (``ros2 run anser_ros NAME``)."""
    return main([Path(sys.argv[0]).name, *sys.argv[1:]])


def exec_node(name: str, arguments: Sequence[str]) -> NoReturn:
    """Replace this process by a node, so that signals reach the node directly."""
    environment = dict(os.environ)
    paths = [str(PACKAGE_FOLDER.parent), environment.get('PYTHONPATH', '')]
    environment['PYTHONPATH'] = os.pathsep.join(path for path in paths if path)
    # -P: a file in the caller's folder must not shadow a module.
    module, _ = {**NODES, **COMPOSED}[name]
    command = [sys.executable, '-P', '-m', module, *arguments]
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, command, environment)


def run_verb(name: str, arguments: Sequence[str]) -> int:
    """Run one offline command in this process and return the exit code."""
    with contextlib.suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # it ends as by Ctrl-C
    from anser_ros.cli.output import remove_empty_folders  # imports what no node needs

    def work() -> int:
        path, words = OFFLINE[name]
        module = importlib.import_module(path)
        parser = OneLineParser(prog=f'anser {name}', description=words)
        module.add_arguments(parser)
        args = parser.parse_args(arguments)
        prepare_process()
        with shared_among(cores()):
            return int(module.run(args)) if hasattr(module, 'run') else _show(name, module, args)

    try:
        code, done, words = attempt(work)
    except SystemExit as leaving:  # the parser has said why
        return leaving.code if isinstance(leaving.code, int) else EXIT_BAD_INPUT
    except KeyboardInterrupt:
        code, done, words = EXIT_BAD_INPUT, None, 'interrupted'
    finally:
        remove_empty_folders()
    if done is not None:
        return int(done)
    print(words if code == EXIT_DEFECT else f'anser {name}: {words}', file=sys.stderr)
    return code


def _show(name: str, module: Any, args: argparse.Namespace) -> int:
    """Do the work of a command under a bar of progress, and show what came of it."""
    from anser_ros.cli.output import progress_of, say

    with progress_of(name) as tell:
        result = module.work(args, tell)
    say(name, result, as_json=args.json)
    return int(result.code)


def attempt(work: Callable[[], Any]) -> tuple[int, Any, str]:
    """Do a piece of work of a command, and distinguish an error of the caller from a defect.

    Returns the exit code; what the work gave, None where it failed; why it failed: one line for
    what is the caller's to mend, a traceback for a defect.
    """
    try:
        return EXIT_OK, work(), ''
    except AnserError as error:
        return EXIT_BAD_INPUT, None, _one_line(error)
    except BrokenPipeError:
        raise
    except Exception as error:  # noqa: BLE001 - the outermost place: whatever is left is a defect
        name = str(getattr(error, 'name', '')).split('.')[0]
        if isinstance(error, ModuleNotFoundError) and name in (*PYPI, 'pandas'):
            return EXIT_BAD_INPUT, None, missing_words(str(error.name))
        # A file that is not there or can't be written is the caller's input, not a defect.
        if isinstance(error, OSError) and error.filename is not None:
            return EXIT_BAD_INPUT, None, f'{error.filename}: {error.strerror}'
        return EXIT_DEFECT, None, traceback.format_exc().rstrip()


def _one_line(error: AnserError) -> str:
    return ' '.join(str(error).split())


def _usage() -> str:
    lines = ['usage: anser VERB [arguments]      (anser VERB --help says which)']
    for title, group in (
        ('nodes:', {**NODES, **COMPOSED}), ('offline, no ROS needed:', OFFLINE),
    ):  # fmt: skip
        lines += ['', title, *(f'  {name:<14} {words}' for name, (_, words) in group.items())]
    return '\n'.join(lines)


PYPI = {
    'allantools': 'allantools',
    'mcap': 'mcap',
    'mcap_ros2': 'mcap-ros2-support',
    'zstandard': 'zstandard',
    'nicegui': 'nicegui',
}
"""Modules without a key of rosdep, and what they are called on PyPI."""
OPTIONAL = ('nicegui',)
"""Of these, what only the live view in a browser needs."""
ROS = 'rclpy'
"""Module that every node needs, and that pip does not install with this package."""
ROS_REMEDY = 'source /opt/ros/jazzy/setup.bash, or use the environment that `make` makes'
NEEDED = {
    'grid': ('mcap',),
    'recorder': ('mcap',),
    'replay': ('mcap', 'mcap_ros2', 'zstandard'),
    **{node: needed for table in extensions.tables('NEEDED') for node, needed in table.items()},
}
"""Nodes that do nothing without one of these packages; all others need ROS alone."""


class MissingPackageError(AnserError):
    """A package that is needed here is not installed."""


def check_packages(node: str) -> None:
    """Raise `MissingPackageError` where a node lacks a package."""
    for module in (ROS, *NEEDED.get(node, ())):
        if not find_spec(module):
            raise MissingPackageError(missing_words(module))


def missing_words(module: str) -> str:
    """Return what is missing, with its remedy; the module may be one inside a package."""
    package = module.split('.')[0]
    remedy = ROS_REMEDY if package == ROS else f'pip install {PYPI.get(package, package)}'
    return f'{package} is not installed: {remedy}'


if __name__ == '__main__':
    sys.exit(main())
