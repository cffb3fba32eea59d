"""Compilation of all numerical kernels, before processes that share their cache need them.

Nodes that start together with an empty cache would each compile all kernels on the same cores.
"""

import sys
import time
from collections.abc import Callable

from anser_ros.cli.supervisor import Child, Supervisor
from anser_ros.wire.config_folder import config_path, read_config
from anser_ros.wire.setup import parse_setup

PATIENT_S = 3.0
"""Time, s, after which the user is told that kernels are being compiled. With a filled cache the
process ends before."""
POLL_S = 0.05
"""Time from one look at the process to the next, s."""
SECOND_NS = 1_000_000_000
"""Nanoseconds in a second."""


def compile_kernels(
    supervisor: Supervisor, say: Callable[[str], None], is_stopped: Callable[[], bool]
) -> Child | None:
    """Run `main` in another process; return it if it failed, and None when all is ready."""
    child = supervisor.start('kernels', [sys.executable, '-P', '-m', 'anser_ros.cli.kernels'])
    begin, announced = time.monotonic(), False
    while child.process.poll() is None and not is_stopped():
        if not announced and time.monotonic() - begin > PATIENT_S:
            say('compiling kernels (once)')
            announced = True
        time.sleep(POLL_S)
    if is_stopped():
        return None
    if child.process.returncode:
        return child
    supervisor.forget(child)
    return None


def main() -> int:
    """Run the demo's world, a tracker and a refit for a few frames."""
    # Imported here, because the process that only starts this one needs none of them.
    import numpy as np

    from anser_ros.refit.live_refit import LiveRefit
    from anser_ros.sessions.model_file import load_model
    from anser_ros.sessions.session import sensor_table
    from anser_ros.sessions.starting_model import board_of
    from anser_ros.simulation.board_source import board_source
    from anser_ros.simulation.metal import steel_disc
    from anser_ros.simulation.motion import Approach
    from anser_ros.simulation.world import World
    from anser_ros.tracking.tracker import Tracker
    from anser_ros.tracking.warm_up import warm_up

    warm_up()
    setup = parse_setup(read_config('demo_setup.yaml'))
    source = board_source(setup)
    far, near = Approach(), Approach(start_s=-1e3, travel_s=1.0, stay_s=1e6)
    worlds = [World(setup, source, metal=[steel_disc(path)]) for path in (far, near)]
    model = load_model(config_path('demo_model.yaml'))
    tools = sensor_table(setup.tool_sensors)
    references = sensor_table(setup.reference_sensors)
    split = len(tools)
    clean = worlds[0].flux(0.0)[split:]
    refit = LiveRefit(model, references, clean, drawing=board_of(setup).field)
    tracker = Tracker(model, tools)
    flags = np.zeros(len(references), dtype=np.int64)
    for frame in range(4):
        flux = worlds[frame > 0].flux(0.02 * frame)
        stamp_ns = SECOND_NS + frame * 20_000_000
        result = refit.update(stamp_ns, references.channel, flux[split:], flags)
        tracker = tracker.with_model(result.model)
        tracker.update(stamp_ns, tools.channel, flux[:split])
    return 0


if __name__ == '__main__':
    sys.exit(main())
