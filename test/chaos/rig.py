"""The chain under trial: a simulated unit, a line that can be damaged, and the real nodes."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from line import Line
from witness import WINDOW_S, Witness

from anser_ros.apps.dashboard.cli.demo import METAL_RADIUS_M
from anser_ros.cli.processes import (
    BOARD_SEED,
    SAMPLE_RATE_HZ,
    Child,
    Supervisor,
    node_command,
    tail,
)
from anser_ros.parallel import ONE_THREAD
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import config_path, read_config

RATE_HZ = 25.0
"""Rate of the fluxes, Hz; low enough for all processes together on two cores."""
PATIENCE_S = 120.0
"""Time for all nodes to come up, s; kernels may be compiled meanwhile."""
WORLDS: dict[str, dict[str, object]] = {
    'clean': {'metal': False},
    # A disc that is on its way in or out nearly all the time.
    'metal': {
        'metal': True, 'metal_radius_m': METAL_RADIUS_M, 'metal_start_s': 9.0,
        'metal_travel_s': 3.0, 'metal_stay_s': 2.0, 'metal_period_s': 9.0,
    },
}  # fmt: skip
"""Parameters of the simulated unit in each of the worlds that faults are tried in."""

REFUSED = 2  # exit code of a node that refuses a parameter or file


def domain_pool() -> Any:
    """Return what gives out ROS domains that no other run on this machine has, to be closed."""
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from domain_pool import DomainPool

    return contextlib.closing(DomainPool())


class Rig:
    """The processes of a world of `WORLDS`, the line between them, and the witness."""

    def __init__(self, folder: Path, domain: int, world: str) -> None:
        self.folder, self.domain, self.world = folder, domain, world
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
        os.environ.update(dict.fromkeys(ONE_THREAD, '1'))
        self.setup = parse_setup(read_config('demo_setup.yaml'))
        self.model = config_path('demo_model.yaml')
        self.rate_hz = SAMPLE_RATE_HZ
        self._ports = Path(tempfile.mkdtemp(prefix='anser_chaos_'))
        self._supervisor = Supervisor(folder / 'logs')
        self._supervisor.__enter__()
        self.children: dict[str, Child] = {}
        self._commands: dict[str, list[str]] = {}
        unit, host = self._ports / 'unit', self._ports / 'host'
        self.line = Line(unit, host)
        self.witness = Witness(self.setup, domain)
        self.start('acquisition', device=host, rate_hz=RATE_HZ)
        self.start('field_model', model_file=self.model, baseline_at_start=True)
        self.start('tracker')
        self.start(
            'cu_simulator', link=unit, board_seed=BOARD_SEED, sample_rate_hz=SAMPLE_RATE_HZ,
            **WORLDS[world],
        )  # fmt: skip
        self.wait_until(self.is_whole, PATIENCE_S, 'a pose of everything')
        # Poses come before the refit is made: a fault then would find nothing that follows it.
        self.wait_until(self.is_followed, PATIENCE_S, 'the refit')
        time.sleep(2.0)  # estimates have settled

    def start(self, node: str, *words: str, called: str = '', **parameters: object) -> None:
        """Start a node under its own or another name."""
        self._commands[called or node] = node_command(node, *words, **parameters)
        self._run(called or node)

    def _run(self, name: str) -> None:
        self.children[name] = self._supervisor.start(name, self._commands[name])

    def pid(self, name: str) -> int:
        """Return the process id of a node."""
        return self.children[name].process.pid

    def signal(self, name: str, number: int) -> None:
        """Send a signal to a node."""
        os.kill(self.pid(name), number)

    def kill(self, name: str) -> None:
        """Kill a node without a warning."""
        child = self.children.pop(name)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.process.pid, signal.SIGKILL)
        child.process.wait(5.0)

    def restart(self, name: str, *words: str, **parameters: object) -> None:
        """Kill a node if it runs, start it again, and wait until it has said something."""
        if name in self.children:
            self.kill(name)
        if parameters or words:
            self.start(name, *words, **parameters)
        else:
            self._run(name)
        begin = time.monotonic()
        said = f'anser/{name}'
        self.wait_until(
            lambda: self.witness.heard_s.get(said, 0.0) > begin, PATIENCE_S, f'a word of {name}'
        )

    def try_refused(self, name: str, **parameters: object) -> None:
        """Start a node anew with what it has to refuse; raise unless it ends by doing so."""
        self.kill(name)
        self.start(name, **parameters)
        child = self.children.pop(name)
        if child.process.wait(PATIENCE_S) != REFUSED:
            raise RuntimeError(f'{name} ended with {child.process.returncode}, not by a refusal')

    def restored(self, name: str) -> Callable[[], None]:
        """Return what starts a node anew as it was before."""
        command = self._commands[name]

        def restore() -> None:
            self._commands[name] = command
            self.restart(name)

        return restore

    def is_whole(self) -> bool:
        """Return whether everything that should have a pose has had one lately."""
        now = time.monotonic()
        names = [*(s.name for s in self.setup.tool_sensors), *self.setup.bodies]
        found = self.witness.count(now - WINDOW_S, now)
        return all(found[name] >= 0.5 * RATE_HZ * WINDOW_S for name in names)

    def is_followed(self) -> bool:
        """Return whether the model follows the references."""
        return float(self.witness.values.get('anser/field_model', {}).get('refit_starts', 0)) > 0

    def crashed(self) -> list[str]:
        """Return what ended by itself, with its last words; each is told once."""
        gone = [n for n, c in self.children.items() if c.process.poll() is not None]
        told = []
        for name in gone:
            child = self.children.pop(name)
            told.append(f'{name} ended with {child.process.returncode}: {tail(child)[-300:]}')
        return told

    def wait_until(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        """Wait for a condition; raise when it does not come true."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise RuntimeError(f'no {what} within {seconds:g} s')
            time.sleep(0.05)

    def call(self, service: str, kind: str = 'Trigger', timeout_s: float = 5.0) -> str:
        """Call a service of std_srvs; return its message."""
        from std_srvs import srv

        client = self.witness.node.create_client(getattr(srv, kind), service)
        if not client.wait_for_service(timeout_s):
            return 'no such service'
        future = client.call_async(getattr(srv, kind).Request())
        self.wait_until(future.done, timeout_s, f'answer of {service}')
        return str(future.result().message)

    def set_parameter(self, node: str, name: str, value: Any) -> None:
        """Change a parameter of a running node."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        client = self.witness.node.create_client(SetParameters, f'{node}/set_parameters')
        client.wait_for_service(5.0)
        request = SetParameters.Request()
        request.parameters = [Parameter(name, value=value).to_parameter_msg()]
        future = client.call_async(request)
        self.wait_until(future.done, 5.0, f'answer of {node}')

    @staticmethod
    def run(*arguments: object, timeout_s: float = 60.0) -> tuple[int, str]:
        """Run a command of `anser`; return its exit code and its last line."""
        command = [sys.executable, '-m', 'anser_ros.cli.main', *map(str, arguments)]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=timeout_s, check=False
            )
        except subprocess.TimeoutExpired:
            return -1, f'no end in {timeout_s:g} s'
        lines = (done.stderr or done.stdout).strip().splitlines()
        return done.returncode, lines[-1] if lines else ''

    def close(self) -> None:
        """End everything."""
        self._supervisor.end()
        self.line.close()
        self.witness.close()
        shutil.rmtree(self._ports, ignore_errors=True)
