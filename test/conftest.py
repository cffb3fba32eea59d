"""A ROS graph of its own for every test, and nothing left running after it.

A test that takes a ROS domain starts nodes: it is marked ``processes``, and so is by hand every
other test that starts one. A test without the mark that starts a process, or a node in its own
process, fails: what `make test-quick` leaves out is exactly what is marked.
"""

import contextlib
import fcntl
import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

# All of this must stand in the environment before the first ROS module is imported.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
# No number, so that no node starts before its test has taken a domain.
os.environ['ROS_DOMAIN_ID'] = 'none taken'
os.environ.setdefault('ROS_LOG_DIR', tempfile.mkdtemp(prefix='anser_ros_log_'))
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
os.environ.setdefault('NUMBA_NUM_THREADS', '1')
if 'PYTEST_XDIST_WORKER' not in os.environ:
    # What nodes keep for those after them is of this run; fonts and kernels are the user's.
    os.environ.setdefault('MPLCONFIGDIR', str(Path('~/.cache/matplotlib').expanduser()))
    os.environ.setdefault('NUMBA_CACHE_DIR', str(Path('~/.cache/numba').expanduser()))
    os.environ['XDG_CACHE_HOME'] = tempfile.mkdtemp(prefix='anser_ros_cache_')
if 'AMENT_PREFIX_PATH' not in os.environ and importlib.util.find_spec('ros_wheels_bootstrapper'):
    os.environ['AMENT_PREFIX_PATH'] = sys.prefix

import pytest
from domain_pool import DomainPool

REPO = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get('ANSER_SHARED', REPO.parent / 'shared'))
PATIENCE_S = 120.0
"""How long a test waits for what must come, s: it only ends what would wait for ever."""
CHAINS = ('recording', 'unit')
"""Chains of nodes by what feeds them."""
PLAYED = ('test_replay', 'test_main_job', 'test_refit_live', 'test_watcher')
"""Files of chains of nodes that a recording feeds, about half the time of all chains; the first
one's tests are short."""
READS_SOURCES = ('test_decisions', 'test_effect_names', 'test_layers')
"""Files that walk the syntax trees of all sources; parsed once, they walk them in a third of the
time."""


# What was started since the last test ended; Python tells of each at the moment of its start.
# What the libraries ask, once, about the machine does not count: the standard library `uname`,
# numpy 1.26 `lscpu`, matplotlib for the list of fonts that it keeps `fc-list`,
# what NiceGUI imports the linker's list of libraries.
ASKED_BY_LIBRARIES = {'uname', 'lscpu', 'fc-list', '/sbin/ldconfig'}
started: list[str] = []


def _note_start(event: str, arguments: tuple[Any, ...]) -> None:
    starts = event in ('subprocess.Popen', 'os.fork', 'os.posix_spawn')
    if starts and not ASKED_BY_LIBRARIES.intersection(arguments[:1]):
        started.append(f'{event} {arguments[:2]}')


sys.addaudithook(_note_start)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels before all workers and the nodes of their tests compile them."""
    if session.config.getoption('numprocesses', None):
        command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', 'warm_up']
        subprocess.run(command, cwd=REPO, check=True, stdout=subprocess.DEVNULL)


def pytest_unconfigure() -> None:
    """Remove what nodes have kept for those after them, hundreds of megabytes."""
    if 'PYTEST_XDIST_WORKER' not in os.environ:
        shutil.rmtree(os.environ['XDG_CACHE_HOME'], ignore_errors=True)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark a test that takes a ROS domain, and name the group that one worker takes as a whole.

    Of three workers one calculates; two take the tests whose nodes are processes, which mostly
    wait: so two chains of nodes run at a time, one that a simulated unit feeds and one that a
    recording does, and a file's fixtures are made once. Nodes in the test's own process do what
    the test says: calculation.
    This must be done as soon as a test is known: later, pytest-xdist has read the groups already.
    """
    if _has_nodes(item):
        item.add_marker('processes')
    if 'PYTEST_XDIST_WORKER' in os.environ:
        item.add_marker(pytest.mark.xdist_group(_chain(item) or _room(item)))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the order be another one, to find tests that depend on what ran before them."""
    words = 'run the files in a random order, and the tests of each in one'
    parser.addoption('--shuffle', type=int, metavar='SEED', help=words)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Shuffle if asked to; of several workers' tests put `CHAINS` and long files first.

    Last come the files whose nodes leave the machine to others, for whichever worker is free.
    """
    seed = config.getoption('shuffle')
    if seed is None:
        items.sort(key=lambda item: item.path.stem != PLAYED[0])
    else:
        rng = random.Random(seed)
        files = list(dict.fromkeys(item.path for item in items))
        rng.shuffle(files)
        rng.shuffle(items)
        items.sort(key=lambda item: files.index(item.path))  # its fixtures are made once
    if 'PYTEST_XDIST_WORKER' in os.environ:
        long = {_room(item) for item in items if item.get_closest_marker('long')}
        chains = (*CHAINS, '')
        items.sort(key=lambda i: (chains.index(_chain(i)), _is_light(i), _room(i) not in long))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Refuse a pytest whose test names do not carry the groups: all workers would start nodes."""
    names = [item.nodeid for item in session.items]
    if 'PYTEST_XDIST_WORKER' in os.environ and not all('@' in name for name in names):
        raise pytest.UsageError('this pytest and pytest-xdist do not know groups together')


_calculates: list[bool] = []


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let a worker that goes over to calculations give way to nodes that others have started."""
    if 'PYTEST_XDIST_WORKER' in os.environ and not _calculates and not _chain(item):
        os.nice(10)
        _calculates.append(True)


def _has_nodes(item: pytest.Item) -> bool:
    return 'domain' in getattr(item, 'fixturenames', ())


def _is_light(item: pytest.Item) -> bool:
    return item.get_closest_marker('light') is not None


def _chain(item: pytest.Item) -> str:
    """Return which group of `CHAINS` a test is of; nothing where it mostly calculates."""
    names = getattr(item, 'fixturenames', ())
    if not _has_nodes(item) or _is_light(item) or ('start' not in names and 'ros' in names):
        return ''
    return CHAINS[0 if item.path.stem in PLAYED else 1]


def _room(item: pytest.Item) -> str:
    """Return the file, or what all files have that share a refit's tables or sources' trees."""
    shares = 'shared_tables' in getattr(item, 'fixturenames', ())
    stem = item.path.stem
    return 'shared_tables' if shares else 'source_trees' if stem in READS_SOURCES else stem


def _has_processes(item: pytest.Item) -> bool:
    return item.get_closest_marker('processes') is not None


@pytest.fixture(autouse=True)
def _starts_are_marked(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    seen = started.copy()
    started.clear()
    assert _has_processes(request.node) or not seen, (
        f'starts a process without @pytest.mark.processes: {seen}'
    )


def by_room(files: Iterable[Path]) -> Any:
    """Give a test the files of one folder of the package after the other; a test each is dear."""
    packages: dict[str, list[Path]] = {}
    for path in files:
        folder = path.parent.relative_to(REPO).as_posix()
        packages.setdefault(folder, []).append(path)
    return pytest.mark.parametrize('paths', packages.values(), ids=packages)


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> Any:
    """Give the test a random generator with the seed of its module."""
    import numpy as np

    return np.random.default_rng(request.module.SEED)


@pytest.fixture(scope='session')
def domains() -> Iterator[DomainPool]:
    """Give the run its pool of domains."""
    pool = DomainPool()
    yield pool
    pool.close()


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch, domains: DomainPool) -> int:
    """Give the test a ROS domain of its own."""
    number = domains.take()
    monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
    return number


@pytest.fixture
def ros(domain: int) -> Iterator[Any]:
    """Give the test an initialised rclpy in its own domain; yields the rclpy module."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    yield rclpy
    rclpy.try_shutdown()


class Process:
    """A process of the test, in a process group of its own, with its output in a file."""

    def __init__(self, arguments: list[str], log: Path, **options: Any) -> None:
        self.log = log
        with log.open('wb') as stream:
            self.popen = subprocess.Popen(
                arguments,
                stdout=stream,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                **options,
            )

    @property
    def output(self) -> str:
        """Return all that it has written so far."""
        return self.log.read_text(errors='replace')

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """Return the exit code, once it has ended."""
        return self.popen.wait(timeout_s)

    def interrupt(self, number: int = signal.SIGINT) -> int:
        """Send a signal and return the exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(number)
        return self.wait()

    def wait_for(self, text: str) -> None:
        """Wait until its output contains a text."""
        assert wait(lambda: text in self.output or self.popen.poll() is not None), self.output
        assert text in self.output, f'ended early:\n{self.output}'

    def kill_group(self) -> None:
        """Kill whatever is left of its process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.popen.pid, signal.SIGKILL)
        self.popen.wait(PATIENCE_S)


def skip_if_too_slow(output: str) -> None:
    """Skip a test of a stream in real time where the nodes say that this computer is too slow."""
    words = 'too slow', 'no pose within', 'gave no pose', 'no stamp is good'
    if any(word in output for word in words):
        pytest.skip('this machine was too busy for a stream in real time')


@pytest.fixture
def start(domain: int, tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Start processes in the test's domain; ``start('tracker', ...)`` is ``anser tracker ...``."""
    started: list[Process] = []

    def run(*arguments: str, **options: Any) -> Process:
        command = [sys.executable, '-m', 'anser_ros.cli.main', *map(str, arguments)]
        log = tmp_path / f'{arguments[0]}_{len(started)}.log'
        options.setdefault('cwd', REPO)
        started.append(Process(command, log, **options))
        return started[-1]

    yield run
    for process in started:
        process.kill_group()


def wait(
    condition: Callable[[], Any],
    meanwhile: Callable[[], Any] = lambda: time.sleep(0.01),
    timeout_s: float = PATIENCE_S,
) -> bool:
    """Do something again and again until a condition holds; return whether it does."""
    end = time.monotonic() + timeout_s
    while not (holds := condition()) and time.monotonic() < end:
        meanwhile()
    return bool(holds)


def spin_until(node: Any, condition: Callable[[], Any]) -> bool:
    """Spin a node until a condition holds; return whether it does."""
    import rclpy

    return wait(condition, lambda: rclpy.spin_once(node, timeout_sec=0.05))


def ask(node: Any, kind: Any, name: str, **values: Any) -> Any:
    """Call a service of a type; return its reply."""
    import rclpy

    client = node.create_client(kind, name)
    assert client.wait_for_service(PATIENCE_S)
    for _ in range(3):  # a reply is lost while the server does not know of its reader yet
        future = client.call_async(kind.Request(**values))
        if wait(future.done, lambda: rclpy.spin_once(node, timeout_sec=0.05), 20.0):
            break
    assert future.done()
    return future.result()


def diagnostics(node: Any) -> dict[str, tuple[int, str, dict[str, str]]]:
    """Return the last level, message and values that each name has in ``/diagnostics``.

    The dictionary is filled while the node spins.
    """
    from diagnostic_msgs.msg import DiagnosticArray

    lines: dict[str, tuple[int, str, dict[str, str]]] = {}

    def take(message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            lines[status.name] = status.level[0], status.message, values

    node.create_subscription(DiagnosticArray, '/diagnostics', take, 100)
    return lines


def needs(*parts: str) -> pytest.MarkDecorator:
    """Let a test be skipped where a folder of the shared data is not there."""
    folder = SHARED.joinpath(*parts)
    return pytest.mark.skipif(not folder.is_dir(), reason=f'no folder {folder}')


@pytest.fixture
def shared() -> Path:
    """Return the folder of the recorded sessions, or skip where it is not there."""
    if not SHARED.is_dir():
        pytest.skip('the folder of recorded sessions is not beside the repository')
    return SHARED


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that the first worker to need it makes; the other waits and reads it."""
    folder = factory.getbasetemp()
    if 'PYTEST_XDIST_WORKER' in os.environ:
        folder = folder.parent
    made = folder / name
    with (folder / f'{name}.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.is_dir():
            begun = folder / f'{name}.begun'
            begun.mkdir()
            make(begun)
            begun.rename(made)
    return made


@pytest.fixture(scope='session')
def factory_calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with model and report of `anser calibrate` on our own factory scan."""
    from anser_ros.cli.main import main

    def make(folder: Path) -> None:
        arguments = ['calibrate', str(REPO / 'bags' / 'factory.mcap')]
        arguments += ['--out', str(folder / 'model.yaml'), '--report', str(folder)]
        assert main(arguments) == 0

    return made_once(tmp_path_factory, 'factory_calibration', make)


@pytest.fixture(scope='session')
def effects_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a model calibrated once on the factory scan of the shared sessions, or skip.

    Its dipoles are given and its sensors taken as they are, which is several times as fast as
    finding both: good to 0.2 mm there.
    """
    scan = SHARED / 'sessions' / 'effects' / 'factory.mcap'
    if not scan.is_file():
        pytest.skip('the folder of recorded sessions is not beside the repository')
    from anser_ros.cli.main import main

    def make(folder: Path) -> None:
        arguments = ['calibrate', str(scan), '--out', str(folder / 'model.yaml')]
        assert main([*arguments, '--dipoles', '12x12', '--estimate', 'none']) == 0

    return made_once(tmp_path_factory, 'effects_model', make) / 'model.yaml'


@pytest.fixture(scope='module')
def shared_tables() -> Iterator[None]:
    """Let refits of the same board in this process share what depends on the geometry alone."""
    from refit_world import tables_made_once

    with tables_made_once():
        yield


@pytest.fixture(scope='module')
def module_refit(shared_tables: None) -> Any:
    """Return a refit of the module, whose geometry is worked out once."""
    from refit_world import anser_world

    return anser_world().refit()


@pytest.fixture
def refit(module_refit: Any) -> Any:
    """Return the module's refit, which has seen nothing."""
    module_refit.reset()
    return module_refit
