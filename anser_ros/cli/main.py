"""The console script `anser`: one verb a command, each also an executable of the ROS package.

A node is started by exec of its own module, so that this layer never loads rclpy; an offline
command is a module of this folder with ``add_arguments(parser)`` and ``run(args) -> int``,
imported only when it is the one asked for.
"""

import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NoReturn

from anser_ros.errors import AnserError
from anser_ros.one_line_parser import OneLineParser

NODES = {
    'acquisition': "samples of a control unit's serial port to fluxes",
    'field_model': 'serves the field model, and refits it while it runs',
    'tracker': 'fluxes to poses with covariance',
    'recorder': 'records the topics into an MCAP bag',
    'replay': 'publishes a bag again: replay BAG [--rate R] [--loop]',
    'openigtlink': 'serves the poses to 3D Slicer as OpenIGTLink',
    'cu_simulator': 'a control unit behind a pseudo-terminal',
    'monitor': 'a live table of sensors, rates and latencies',
    'watcher': 'names live, in /diagnostics, what the model lacks',
}
EXIT_OK = 0
EXIT_DEFECT = 1
EXIT_BAD_INPUT = 2
# Small matrices: a second BLAS thread gains nothing, and waits for a busy core for milliseconds.
ONE_THREAD = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')
PACKAGE_FOLDER = Path(__file__).resolve().parents[1]


def node_names() -> list[str]:
    """Return the nodes whose modules are there."""
    return [name for name in NODES if (PACKAGE_FOLDER / 'nodes' / f'{name}.py').is_file()]


def verb_names() -> list[str]:
    """Return the offline commands: the modules of this folder that take arguments."""
    modules = sorted(Path(__file__).parent.glob('*.py'))
    mark = '\ndef add_arguments('
    return [path.stem for path in modules if mark in path.read_text(encoding='utf-8')]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.

    Parameters
    ----------
    argv : sequence of str, optional
        The verb and its arguments; those of the process when not given.

    Returns
    -------
    int
        0 done, 2 bad usage or bad input (one clear line on stderr), 1 a defect (a traceback).
    """
    for variable in ONE_THREAD:  # before anything imports numpy
        os.environ.setdefault(variable, '1')
    try:
        code = _dispatch(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read the output has had enough
        sys.stdout = open(os.devnull, 'w', encoding='utf-8')  # noqa: SIM115 - until the exit
        return EXIT_OK
    return code


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ('-h', '--help'):
        print(_usage())
        return EXIT_OK if arguments else EXIT_BAD_INPUT
    if arguments[0] == '--version':
        print(_version())
        return EXIT_OK
    name, rest = arguments[0].replace('-', '_'), arguments[1:]
    if name in node_names():
        exec_node(name, rest)
    if name in verb_names():
        return run_verb(name, rest)
    known = ', '.join(node_names() + verb_names())
    print(f'anser: no command {arguments[0]!r}; there are: {known}', file=sys.stderr)
    return EXIT_BAD_INPUT


def run_executable() -> int:
    """Run the verb that the executable is named after (``ros2 run anser_ros NAME``)."""
    return main([Path(sys.argv[0]).name, *sys.argv[1:]])


def exec_node(name: str, arguments: Sequence[str]) -> NoReturn:
    """Replace this process by a node, so that signals reach it without a go-between."""
    environment = dict(os.environ)
    paths = [str(PACKAGE_FOLDER.parent), environment.get('PYTHONPATH', '')]
    environment['PYTHONPATH'] = os.pathsep.join(path for path in paths if path)
    # -P: a file in the caller's folder must not shadow a module.
    command = [sys.executable, '-P', '-m', f'anser_ros.nodes.{name}', *arguments]
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, command, environment)


def run_verb(name: str, arguments: Sequence[str]) -> int:
    """Run one offline command in this process."""
    try:
        # Before numpy is loaded: BLAS threads that wait for one another cost more than they bring.
        os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
        module = importlib.import_module(f'anser_ros.cli.{name}')
        summary = (module.__doc__ or '').strip().split('\n')[0]
        parser = OneLineParser(prog=f'anser {name}', description=summary)
        module.add_arguments(parser)
        args = parser.parse_args(arguments)
        return int(module.run(args))
    except AnserError as error:
        print(f'anser {name}: {_one_line(error)}', file=sys.stderr)
        return EXIT_BAD_INPUT
    except BrokenPipeError:
        raise
    except OSError as error:
        # A file that is not there or can't be written is the caller's input, not a defect.
        if error.filename is None:
            traceback.print_exc()
            return EXIT_DEFECT
        print(f'anser {name}: {error.filename}: {error.strerror}', file=sys.stderr)
        return EXIT_BAD_INPUT
    except SystemExit as leaving:  # the parser has said why
        return leaving.code if isinstance(leaving.code, int) else EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(f'anser {name}: interrupted', file=sys.stderr)
        return EXIT_BAD_INPUT
    except Exception:  # noqa: BLE001 - the outermost place: whatever is left is a defect
        traceback.print_exc()
        return EXIT_DEFECT


def _one_line(error: AnserError) -> str:
    return ' '.join(str(error).split())


def _version() -> str:
    try:
        return f'anser_ros {version("anser_ros")}'
    except PackageNotFoundError:
        return 'anser_ros, not installed'


def _summary(path: Path) -> str:
    """Return the first line of a module's docstring without importing the module."""
    first = path.read_text(encoding='utf-8').lstrip().split('\n', 1)[0]
    return first.strip('"').rstrip('.')


def _usage() -> str:
    lines = ['usage: anser VERB [arguments]      (anser VERB --help says which)', '', 'nodes:']
    lines += [f'  {name:<14} {NODES[name]}' for name in node_names()]
    lines += ['', 'offline, no ROS needed:']
    folder = Path(__file__).parent
    lines += [f'  {name:<14} {_summary(folder / f"{name}.py")}' for name in verb_names()]
    return '\n'.join(lines)


if __name__ == '__main__':
    sys.exit(main())
