"""The warm-up: afterwards no frame waits for a kernel."""

import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent

FIRST_FRAMES = """
import sys
from numba.core.dispatcher import Dispatcher
from anser_ros.tracking.tracker import warm_up

def compiled():
    packages = [m for name, m in sys.modules.items() if name.startswith('anser_ros.tracking.')]
    found = [value for package in packages for value in vars(package).values()]
    kernels = {id(value): value for value in found if isinstance(value, Dispatcher)}
    return {kernel.py_func.__qualname__: len(kernel.signatures) for kernel in kernels.values()}

warm_up()
before = compiled()
from tracked_tool import CHANNELS, MODEL, TOOL, path
from tracking_world import anser_board, fluxes
from anser_ros.field.nominal import nominal_model
from anser_ros.tracking.tracker import Tracker
for model in (MODEL, nominal_model(anser_board())):
    tracker = Tracker(model, TOOL)
    for stamp, position, rotation in path(5):
        tracker.update(stamp, CHANNELS, fluxes(model, TOOL, position, rotation))
print({name: count for name, count in compiled().items() if count != before.get(name)})
print(len(before))
"""


@pytest.mark.processes
def test_after_the_warm_up_no_frame_waits_for_a_kernel():
    """In a process of its own, as a node's is."""
    command = [sys.executable, '-c', FIRST_FRAMES]
    done = subprocess.run(command, capture_output=True, text=True, cwd=HERE, check=False)
    assert done.returncode == 0, done.stderr
    late, kernels = done.stdout.splitlines()
    assert late == '{}'
    assert int(kernels) > 10
