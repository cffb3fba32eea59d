"""The process of one node: its arguments, its signals, its executor and its exit code."""

import argparse
import gc
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Sequence
from types import FrameType
from typing import TYPE_CHECKING, Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from anser_ros.errors import AnserError, ParameterError
from anser_ros.nodes import parameter_files, parameters
from anser_ros.one_line_parser import OneLineParser
from anser_ros.wire.config_folder import config_path

if TYPE_CHECKING:
    from anser_ros.nodes.node import AnserNode

# How long a signal may go unnoticed by an idle node.
SPIN_SLICE_S = 0.1
# Where Fast DDS looks for profiles; the user's own ones hold.
PROFILE_VARIABLES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
PROFILES = 'fastdds.xml'
# Without it, rmw_fastrtps sets how the memory of messages is kept itself; the ROS QoS hold anyway.
READ_PROFILES = 'RMW_FASTRTPS_USE_QOS_FROM_XML'
ENDING = (signal.SIGINT, signal.SIGTERM)
# How long a busy one may take to notice it.
NOTICE_S = 1.5


def main(node_class: 'type[AnserNode]', argv: Sequence[str] | None = None) -> int:
    """Run one node until it ends, or until SIGINT or SIGTERM.

    Returns
    -------
    int
        0 ended as asked; 2 a wrong argument or parameter, said in one line; 1 a defect.
    """
    arguments = list(sys.argv if argv is None else argv)
    try:
        own = _parse(node_class, _without_ros(arguments))
        signals = _Signals()
        _choose_profile()
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        return _run(node_class, own, arguments, signals)
    except AnserError as error:
        print(f'{node_class.NAME}: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    except (_Interrupted, rclpy.exceptions.ROSInterruptException):
        return 0
    except Exception:  # noqa: BLE001 - the outermost place: whatever is left is a defect
        traceback.print_exc()
        return 1
    finally:
        rclpy.try_shutdown()


def _choose_profile() -> None:
    """Let the middleware announce nodes more often, and give back the memory of messages.

    The first is so that nodes find each other at once, the second so that a huge message leaves
    nothing behind.
    """
    if not any(os.environ.get(variable) for variable in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[0]] = str(config_path(PROFILES))
        os.environ.setdefault(READ_PROFILES, '1')


def _without_ros(arguments: Sequence[str]) -> list[str]:
    """Return the node's own arguments, the program's name left out."""
    try:
        return list(remove_ros_args(arguments)[1:])
    except (RCLError, UnknownROSArgsError) as error:  # such as a params file that is none
        raise ParameterError(f'ROS arguments: {error}') from error


def _parse(node_class: 'type[AnserNode]', arguments: Sequence[str]) -> dict[str, Any]:
    summary = (sys.modules[node_class.__module__].__doc__ or '').strip().split('\n')[0]
    table = parameters.describe(node_class.PARAMETERS)
    parser = OneLineParser(
        prog=f'anser {node_class.NAME}',
        description=summary,
        epilog=f'parameters (--ros-args -p NAME:=VALUE, or --params-file):\n{table}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    node_class.add_arguments(parser)
    return vars(parser.parse_args(arguments))


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

    rclpy's own handlers end the context at once, so that a node could neither close its files
    in order nor say its last word in ``/diagnostics``. A node that is still being made is given
    up on the spot; one whose main thread does not get round to noticing, for a kernel is being
    compiled, is ended by a thread that does.
    """

    def __init__(self) -> None:
        self.is_node_made = False
        self.caught: list[int] = []
        self._noticed = threading.Event()
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
        if not self._noticed.wait(NOTICE_S):
            sys.stderr.flush()
            os._exit(0)


def make_executor() -> Executor:
    """Return the executor of a node: one thread, told of events where rclpy can do that.

    With a dozen topics the waiting of the older one, which looks through all entities for every
    message, costs several times what is done with the message. Jazzy has both since rclpy 7.1.4.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def _run(
    node_class: 'type[AnserNode]',
    own: dict[str, Any],
    arguments: Sequence[str],
    signals: _Signals,
) -> int:
    node, code = None, 0
    executor = make_executor()
    try:
        node = node_class(**own)
        for text in parameter_files.complaints(arguments, node.get_name()):
            node.get_logger().warning(text)
        executor.add_node(node)
        # What is there now stays: looking through all of it for garbage takes up to 0.1 s.
        gc.collect()
        gc.freeze()
        signals.is_node_made = True
        while not signals.caught and node.exit_code is None:
            executor.spin_once(timeout_sec=SPIN_SLICE_S)
        code = node.exit_code or 0
    finally:
        signals.ignore()
        if node is not None:
            node.close()
            node.publish_end()
            executor.shutdown(timeout_sec=1.0)
            node.destroy_node()
    return code
