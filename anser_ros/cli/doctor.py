"""Look at the installation and the machine, and name a remedy for each problem."""

import argparse
import ctypes
import errno
import glob
import grp
import json
import os
import re
import shutil
import stat
import struct
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from rich.markup import escape

from anser_ros.cli.commands import NODES
from anser_ros.cli.main import OPTIONAL, PYPI, ROS_REMEDY
from anser_ros.cli.output import Result, Tell, add_json, terminal_table
from anser_ros.errors import ParameterError

SCHEMA = 'anser_doctor/1'
GOOD, NOTE, BAD = 'ok', 'note', 'problem'
COLOURS = {GOOD: 'green', NOTE: 'yellow', BAD: 'red'}
TESTED = ((3, 11), (3, 12))
"""Versions of Python that the tests run with."""
MODULES = ('numpy', 'pandas', 'scipy', 'numba', 'yaml', 'serial', 'rich', 'matplotlib', 'h5py')
"""Modules that come by rosdep or pip; those of `PYPI` by pip only."""
DISTRIBUTIONS = {'yaml': 'PyYAML', 'serial': 'pyserial', **PYPI}
"""What the distribution of a module is called where that is another name."""
LONGEST_LOOK_S = 60.0  # nodes say what they have to say once a second
LOOK_S = 2.0
"""How long the graph is looked at, s: nodes speak in /diagnostics once a second."""
PATIENCE_S = 20.0
"""Time that the look may take beyond that, s: ROS loads slowly from a cold disk."""
LEAST_FREE_BYTES = 2 * 2**30
"""Free disk space below which a recording is at risk, bytes: an hour of the usual fluxes."""
PORTS = ('/dev/ttyACM*', '/dev/ttyUSB*')
SAFE_DOMAINS, DOMAINS = range(102), range(233)
"""Values of ROS_DOMAIN_ID whose ports nobody else is given, and all that DDS has ports for."""
MOST_CLOCK_ERROR_US = 16_000_000
"""Largest error, us, that the kernel states of a clock that is kept right, as for timedatectl."""
TIMEX_BYTES = 512
"""Room for the kernel's record of its clock, bytes: more than any of its versions takes."""


class Observation(NamedTuple):
    """Holds one thing that was looked at: how it is, and what to do where it is not well."""

    name: str
    state: str
    found: str
    remedy: str = ''


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = 'example: anser doctor --device /dev/ttyACM0'
    parser.add_argument('--device', help="the control unit's port; all usual ones by default")
    words = 'how long to look at the graph, s'
    parser.add_argument('--seconds', type=float, default=LOOK_S, help=words)
    add_json(parser, 'the findings as JSON')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Look at everything; the exit code is 2 where something is wrong."""
    if not 0.0 < args.seconds <= LONGEST_LOOK_S:
        raise ParameterError(
            f'--seconds must be above 0 and at most {LONGEST_LOOK_S:g}, got {args.seconds:g}'
        )
    looks: dict[str, Callable[[], list[Observation]]] = {
        'Python': python,
        'packages': packages,
        'kernels': kernels,
        'ports': lambda: ports(args.device),
        'clock': clock,
        'disk': lambda: disk(Path.cwd()),
        'the domain': domain,
        'the graph': lambda: graph(args.seconds),
    }
    findings: list[Observation] = []
    for name, look in looks.items():
        tell(f'looking at {name}')
        findings += look()
    count = sum(finding.state == BAD for finding in findings)
    words = f'{count} problem{"s" if count > 1 else ""}' if count else 'nothing is wrong'
    listed = [finding._asdict() for finding in findings]
    document = {'schema': SCHEMA, 'problems': count, 'findings': listed}
    rows = [
        [f'[{COLOURS[one.state]}]{escape(one.name)}', escape(one.found), escape(one.remedy)]
        for one in findings
    ]
    table = terminal_table(['', 'found', 'remedy'], rows)
    return Result(document, (), (table, words), code=2 if count else 0)


def python() -> list[Observation]:
    """Check the interpreter: whether it is one that is tested."""
    words = sys.version.split()[0]
    if sys.version_info[:2] in TESTED:
        return [Observation('Python', GOOD, words)]
    tested = ' and '.join('.'.join(map(str, one)) for one in TESTED)
    return [Observation('Python', NOTE, words, f'tested are {tested}')]


def packages(has: Callable[[str], Any] = find_spec) -> list[Observation]:
    """Check every package that is imported somewhere: its version, or how to get it."""
    found = []
    for module in (*MODULES, *PYPI):
        name = DISTRIBUTIONS.get(module, module)
        if not has(module):
            state = NOTE if module in OPTIONAL else BAD
            found.append(Observation(name, state, 'not installed', f'pip install {name}'))
            continue
        try:
            text = version(name)
        except PackageNotFoundError:
            text = 'installed, version unknown'
        found.append(Observation(name, GOOD, text))
    return found


def kernels() -> list[Observation]:
    """Check the compiled kernels: whether the first start has to wait for them."""
    # Late, as numba may be what is missing.
    if not find_spec('numba'):
        return []
    from anser_ros.kernel_cache import KernelCache

    cache = KernelCache()
    if cache.is_full:
        return [Observation('kernels', GOOD, f'all {cache.total} are compiled')]
    words = 'not all compiled: the first start compiles the rest, which takes up to a minute'
    return [Observation('kernels', NOTE, words, 'anser warm_up')]


def ports(device: str | None, patterns: tuple[str, ...] = PORTS) -> list[Observation]:
    """Check the serial ports: whether there is one, and may be opened."""
    names = [device] if device else sorted(n for p in patterns for n in glob.glob(p))
    if not names:
        words = f'none of {", ".join(patterns)}'
        return [Observation('port', NOTE, words, 'plug the control unit in, or simulate:=true')]
    return [_port(name) for name in names]


NO_PORT, PORT_NAME = 'is not a serial port', 'see dmesg for the name of the port'


def _port(name: str) -> Observation:
    """One port; it is opened for a moment, as only so it shows whether it is one."""
    if not os.path.exists(name):
        return Observation(name, BAD, 'not there', 'plug it in; see dmesg for its name')
    if not os.access(name, os.R_OK | os.W_OK):
        group = _group(name)
        remedy = f'sudo usermod -aG {group} $USER, then log out and in again'
        if not group:
            remedy = f'sudo chmod a+rw {name}; a udev rule with MODE="0666" makes that last'
        return Observation(name, BAD, 'no permission to read and write it', remedy)
    if not stat.S_ISCHR(os.stat(name).st_mode):
        return Observation(name, BAD, NO_PORT, PORT_NAME)
    try:
        handle = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        if error.errno == errno.EBUSY:
            words = 'another program uses it exclusively'
            return Observation(name, NOTE, words, f'fine if that is acquisition: fuser {name}')
        words = f'cannot be opened: {error.strerror}'
        return Observation(name, BAD, words, 'unplug it and plug it in; see dmesg')
    try:
        if os.isatty(handle):
            return Observation(name, GOOD, 'can be opened')
    finally:
        os.close(handle)
    return Observation(name, BAD, NO_PORT, PORT_NAME)


def _group(name: str) -> str:
    """The group that may use a port, to which users can be added; empty for none."""
    about = os.stat(name)
    try:
        group = grp.getgrgid(about.st_gid).gr_name
    except KeyError:
        return ''
    needed = stat.S_IRGRP | stat.S_IWGRP
    return group if about.st_mode & needed == needed and group != 'root' else ''


def clock() -> list[Observation]:
    """Check the system's clock: whether something keeps it right, as two machines need it."""
    kept = kernel_clock()
    if kept is None:
        return [Observation('clock', NOTE, 'unknown: no time service reports it')]
    if kept:
        return [Observation('clock', GOOD, 'synchronised')]
    remedy = 'install chrony, or timedatectl set-ntp true'
    return [Observation('clock', NOTE, 'not synchronised with other machines', remedy)]


def kernel_clock() -> bool | None:
    """Return whether something keeps the kernel's clock right; None where it does not say."""
    record = ctypes.create_string_buffer(TIMEX_BYTES)
    try:
        state = ctypes.CDLL(None).adjtimex(record)
    except (OSError, AttributeError):
        return None
    *_, most_us = struct.unpack_from('@Illl', record)  # modes, offset, frequency, largest error
    return None if state < 0 else most_us < MOST_CLOCK_ERROR_US


def disk(folder: Path) -> list[Observation]:
    """Check the disk under a folder: whether a recording has room."""
    free = shutil.disk_usage(folder).free
    words = f'{free / 2**30:.1f} GB free in {folder}'
    if free < LEAST_FREE_BYTES:
        return [Observation('disk', BAD, words, 'make room, or record elsewhere (directory:=...)')]
    return [Observation('disk', GOOD, words)]


def domain() -> list[Observation]:
    """Check which of the network's graphs is ours: whether its number is one that works."""
    text = os.environ.get('ROS_DOMAIN_ID', '0')
    number = int(text) if re.fullmatch('[0-9]{1,9}', text) else -1
    if number in SAFE_DOMAINS:
        return []
    remedy = f'export ROS_DOMAIN_ID=N, with N from 0 to {SAFE_DOMAINS[-1]}'
    if number in DOMAINS:
        words = f'{text}: Linux gives its ports to other programs too'
        return [Observation('ROS_DOMAIN_ID', NOTE, words, remedy)]
    return [Observation('ROS_DOMAIN_ID', BAD, f'{text!r} is not a domain', remedy)]


def graph(seconds: float) -> list[Observation]:
    """Check the ROS graph: the middleware, which nodes are there, and what they complain of."""
    if any(one.state == BAD for one in domain()):
        return []
    code = f'from anser_ros.nodes.graph_look import main; main({seconds!r})'
    try:
        done = subprocess.run(
            [sys.executable, '-c', code], capture_output=True, text=True, check=False,
            timeout=seconds + PATIENCE_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        remedy = 'look at RMW_IMPLEMENTATION and the network'
        return [Observation('ROS', BAD, 'the middleware does not answer', remedy)]
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f'exit code {done.returncode}'])[-1]
        last = re.sub(r'^(\[[^]]*\] *)+: *', '', last)  # a log's level, time and name
        return [Observation('ROS', BAD, last, _ros_remedy(last))]
    graph = json.loads(done.stdout.strip().splitlines()[-1])
    return graph_findings(graph)


def _ros_remedy(last: str) -> str:
    """What to do where ROS does not start, by the last line that it said."""
    if 'rmw' in last.lower():
        chosen = os.environ.get('RMW_IMPLEMENTATION', '').replace('_', '-')
        return f'unset RMW_IMPLEMENTATION, or sudo apt install ros-jazzy-{chosen}'
    return ROS_REMEDY


def graph_findings(graph: dict[str, Any]) -> list[Observation]:
    domain = os.environ.get('ROS_DOMAIN_ID', '0')
    reach = os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    words = f'{graph["middleware"]}, domain {domain}, discovery {reach}'
    found = [Observation('ROS', GOOD, words)]
    for name in graph['twice']:
        remedy = 'end one, or give it a namespace or ROS_DOMAIN_ID of its own'
        found.append(Observation(name, BAD, 'runs more than once', remedy))
    ours = [name for name in graph['nodes'] if name.rsplit('/', 1)[-1] in NODES]
    count, topics = len(graph['nodes']), graph['topics']
    words = f'{count} nodes, {len(ours)} of them from anser_ros, {topics} topics'
    found.append(Observation('graph', GOOD, words))
    for name, text in graph['complaints'].items():
        found.append(Observation(name, NOTE, text, 'docs/faults.md explains the states'))
    return found
