"""Runs the process of one or several nodes: memory, arguments, signals, executor and exit code."""

import argparse
import ctypes
import gc
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from types import FrameType
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from anser_ros.errors import AnserError, OneLineParser, ParameterError
from anser_ros.nodes.runtime import parameters
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.runtime.parameters import complaints, names_for
from anser_ros.wire.text_files import config_path

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Parameters of glibc's ``mallopt``, as <malloc.h> numbers them."""
LARGE = 4 * 1024 * 1024
"""Bytes from which on a block has pages of its own, which are given back: more than is made for a
frame, which `field_model` otherwise waits for."""
MOST_FREE = 64 * 1024 * 1024
"""Free bytes at the end of the heap that are kept, as many as glibc itself comes to keep."""
GIVE_BACK_S = 60.0
"""Time, s, after which garbage is looked for, and free pages are given back but for the last
`LARGE` bytes: 1 to 4 ms each, 15 where Numba came after the start. Python itself looks through old
objects when 70,000 more have come to stay: hundreds of reconnections of 100 kB each. What lies
free in pieces of less than a page stays."""


def keep_in_one_piece() -> Callable[[], object]:
    """Set the allocator so that a node that runs for days does not break its memory into pieces.

    Returns what gives free pages back. glibc raises the bound from which blocks are given back,
    and has a heap for each thread: `field_model` had 612 MB after twenty minutes, and has 511 so.
    Others' allocators are left.
    """
    try:
        own = ctypes.CDLL(None)
        set_option, give_back = own.mallopt, own.malloc_trim
    except (OSError, AttributeError):
        return lambda: None
    set_option(M_ARENA_MAX, 1)
    set_option(M_MMAP_THRESHOLD, LARGE)
    set_option(M_TRIM_THRESHOLD, MOST_FREE)
    return partial(give_back, ctypes.c_size_t(LARGE))


# How long a signal may go unnoticed by an idle node.
SPIN_SLICE_S = 0.1
ENDING = (signal.SIGINT, signal.SIGTERM)
NOTICE_S = 1.0
"""How long, s, a busy process may take to notice that it is to end, before it is ended."""


def main(
    node_class: type[AnserNode] | Sequence[type[AnserNode]],
    argv: Sequence[str] | None = None,
    name: str = '',
    join: Callable[..., None] | None = None,
) -> int:
    """Run nodes until one of them ends, or until SIGINT or SIGTERM; return the exit code.

    Nodes of several classes are connected by ``join``, which takes them in this order; the process
    then needs a name of its own. The code is 0 where it ended as asked, 2 for a wrong argument or
    parameter, reported in one line, and 1 for a defect.
    """
    arguments = list(sys.argv if argv is None else argv)
    classes = tuple(node_class) if isinstance(node_class, Sequence) else (node_class,)
    name = name or classes[0].NAME
    try:
        own = _parse(name, classes, _without_ros(arguments))
        renaming = '__node:=', '__name:='  # of all nodes of a process, which several can't be
        if len(classes) > 1 and any(text.startswith(renaming) for text in arguments):
            raise ParameterError(f'one node is renamed by -r {classes[-1].NAME}:__node:=NAME')
        signals = _Signals()
        _choose_profile()
        common, meant = _meant_for(classes, arguments)
        rclpy.init(args=common, signal_handler_options=SignalHandlerOptions.NO)
        return _run(classes, own, arguments, meant, signals, join)
    except AnserError as error:
        print(f'{name}: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    except (_Interrupted, rclpy.exceptions.ROSInterruptException):
        return 0
    except Exception:  # noqa: BLE001 - the outermost place: whatever is left is a defect
        traceback.print_exc()
        return 1
    finally:
        rclpy.try_shutdown()


def _choose_profile() -> None:
    """Let nodes find each other at once, and the middleware give back the memory of messages."""
    # Where Fast DDS looks for profiles; the user's own ones hold.
    variables = 'FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE'
    if not any(os.environ.get(variable) for variable in variables):
        os.environ[variables[0]] = str(config_path('fastdds.xml'))
        # Without it, rmw_fastrtps sets how memory is kept itself; the ROS QoS hold anyway.
        os.environ.setdefault('RMW_FASTRTPS_USE_QOS_FROM_XML', '1')


def _without_ros(arguments: Sequence[str]) -> list[str]:
    """Return the node's own arguments, the program's name left out."""
    try:
        return list(remove_ros_args(arguments)[1:])
    except (RCLError, UnknownROSArgsError) as error:  # such as a file without parameters
        raise ParameterError(f'ROS arguments: {error}') from error


def _parse(
    name: str, classes: Sequence[type[AnserNode]], arguments: Sequence[str]
) -> dict[str, Any]:
    module = classes[0].__module__ if len(classes) == 1 else '__main__'
    summary = (sys.modules[module].__doc__ or '').strip().split('\n')[0]
    tables = {node.NAME: parameters.describe(node.PARAMETERS) for node in classes}
    prefix, example, (table, *_) = '', classes[0].EXAMPLE, tables.values()
    if len(classes) > 1:
        prefix, example = 'NODE:', example.replace('-p ', f'-p {classes[0].NAME}:')
        table = '\n'.join(f'{node}:\n{text}' for node, text in tables.items())
    parser = OneLineParser(
        prog=f'anser {name}',
        description=summary,
        epilog=f'example: anser {name} {example}\n\n'
        f'parameters (--ros-args -p {prefix}NAME:=VALUE, or --params-file):\n{table}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for node in classes:
        node.add_arguments(parser)
    return vars(parser.parse_args(arguments))


def _meant_for(
    classes: Sequence[type[AnserNode]], arguments: Sequence[str]
) -> tuple[list[str], dict[str, list[str]]]:
    """Split off the parameters of one node among several, ``-p NODE:NAME:=VALUE``.

    ROS does not find a node in a namespace in this way, and ignores the value.
    """
    common, meant = [], {node.NAME: ['--ros-args'] for node in classes}
    left = iter(arguments)
    for text in left:
        value = next(left, '') if text in ('-p', '--param') else None
        node, _, rule = (value or '').partition(':')
        if len(classes) > 1 and node in meant and ':=' in rule:
            name = rule.partition(':=')[0]
            owners = [c.NAME for c in classes if parameters.is_known(c.PARAMETERS, name)]
            if node not in owners:
                hint = f'; {" and ".join(owners)} has it' if owners else ''
                raise ParameterError(f'{node} has no parameter {name}{hint}')
            meant[node] += [text, rule]
        else:
            common += [text] if value is None else [text, value]
    return common, meant


class _Interrupted(BaseException):
    """A signal came while the node was still being made."""


def _is_compiling(frame: FrameType | None) -> bool:
    """Return whether the compiler is at work: exceptions in its callbacks are printed and lost."""
    while frame is not None:
        if str(frame.f_globals.get('__name__', '')).startswith('llvmlite.'):
            return True
        frame = frame.f_back
    return False


class _Signals:
    """Catches SIGINT and SIGTERM from now on.

    rclpy's own handlers end the context before a node could close its files or publish its last
    diagnostics. A node that is still being constructed is abandoned at once; one whose main thread
    cannot react, because a kernel is being compiled, is ended by another thread.
    """

    def __init__(self) -> None:
        self.is_node_made = False
        self.caught: list[int] = []
        self._noticed = threading.Event()
        self.nodes: list[AnserNode] = []
        for number in ENDING:
            signal.signal(number, self._catch)
        # Python's handlers wait for the main thread; this channel does not.
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._watch, name='signals', daemon=True).start()

    def ignore(self) -> None:
        """Ignore all further ones: a second Ctrl-C must not cut the closing of files short."""
        self._noticed.set()
        for number in ENDING:
            signal.signal(number, signal.SIG_IGN)

    def _catch(self, number: int, frame: FrameType | None) -> None:
        self.caught.append(number)
        if not self.is_node_made and not _is_compiling(frame):
            raise _Interrupted

    def _watch(self) -> None:
        while self._reader.recv(1)[0] not in ENDING:
            pass
        if self._noticed.wait(NOTICE_S):
            return
        for node in self.nodes:
            try:
                node.on_abandon()
            except Exception:  # noqa: BLE001 - the process ends, whatever a device says
                traceback.print_exc()
        if not self._noticed.is_set():
            sys.stderr.flush()
            os._exit(0)


def make_executor() -> Executor:
    """Return the executor of a node: one thread, called for events where rclpy has that (7.1.4).

    The older one looks through all entities for every message, which costs several times what is
    done with the message.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def _run(
    classes: Sequence[type[AnserNode]],
    own: dict[str, Any],
    arguments: Sequence[str],
    meant: dict[str, list[str]],
    signals: _Signals,
    join: Callable[..., None] | None,
) -> int:
    nodes, code = signals.nodes, 0
    give_back, given_back_s = keep_in_one_piece(), time.monotonic()
    executor = make_executor()
    try:
        for node_class in classes:
            if len(classes) > 1:
                own |= {'beside': classes, 'cli_args': meant[node_class.NAME]}
            nodes.append(node_class(**own))
        _complain(nodes, arguments)
        if join is not None:
            join(*nodes)
        for node in nodes:
            executor.add_node(node)
        # What is there now stays: looking through all of it for garbage takes up to 0.1 s.
        gc.collect()
        gc.freeze()
        gc.enable()
        signals.is_node_made = True
        # The older executor takes one message a turn, so that a pause after each would not do.
        has_events = not isinstance(executor, SingleThreadedExecutor)
        pause_s = min(node.PAUSE_S for node in nodes) if has_events else 0.0
        while not signals.caught and all(node.exit_code is None for node in nodes):
            if pause_s:
                time.sleep(pause_s)
                executor.spin_until_future_complete(Future(), timeout_sec=0.0)
            else:
                executor.spin_once(timeout_sec=SPIN_SLICE_S)
            if time.monotonic() - given_back_s > GIVE_BACK_S:
                gc.collect()
                give_back()
                given_back_s = time.monotonic()
        code = max(node.exit_code or 0 for node in nodes)
    finally:
        signals.ignore()
        for node in nodes:
            node.close()
        working = [node for node in nodes if not node.stop_working()]
        for node in nodes:
            node.publish_end()
        if nodes:
            executor.shutdown(timeout_sec=1.0)
        if working:  # a thread that still calculates must not meet a node that is gone
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
        for node in nodes:
            node.destroy_node()
    return code


def _complain(nodes: Sequence[AnserNode], arguments: Sequence[str]) -> None:
    """Warn of parameter files that say nothing to any of the nodes.

    Raises `ParameterError` when the section of one node among several has a value that it does not
    know.
    """
    for node in nodes if len(nodes) > 1 else ():
        for name in names_for(arguments, node.get_name()):
            if not parameters.is_known(node.PARAMETERS, name):
                raise ParameterError(f'{node.get_name()} has no parameter {name}')
    refusals = [complaints(arguments, node.get_fully_qualified_name()) for node in nodes]
    if all(refusals):
        for text in refusals[-1]:
            nodes[-1].get_logger().warning(text)
