"""Kernels are compiled once, and no frame waits for one after the warm-up."""

import contextlib
import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from numba.core.dispatcher import Dispatcher

from anser_ros import kernel_cache
from anser_ros.errors import ParameterError
from anser_ros.kernel_cache import PACKAGE, KernelCache


def test_it_is_full_when_all_has_been_compiled(tmp_path):
    cache = KernelCache(tmp_path)
    assert not cache.is_full
    assert cache.done == 0
    (tmp_path / 'rotations.fill_tangent-16.py311.nbi').touch()
    assert cache.done == 1
    cache.finish()
    assert KernelCache(tmp_path).is_full


@pytest.mark.processes
def test_copies_of_the_package_share_kernels_by_content(tmp_path):
    """A second copy loads what the first one compiled; with another source it does not."""
    code = (
        'import numpy as np; from anser_ros.physics.rotations import fill_tangent as f\n'
        'f(np.array([0.0, 0.0, 1.0]), np.zeros((2, 3)))\n'
        'print(sum(f.stats.cache_hits.values()), sum(f.stats.cache_misses.values()))'
    )
    found = []
    for name in ('clone', 'built', 'changed'):
        package = tmp_path / name / 'anser_ros'
        shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns('__pycache__'))
        if name == 'changed':
            with (package / 'frames' / 'intake.py').open('a') as source:
                source.write('# other\n')
        env = {**os.environ, 'PYTHONPATH': str(package.parent), 'XDG_CACHE_HOME': str(tmp_path)}
        env.pop('NUMBA_CACHE_DIR', None)
        command = [sys.executable, '-P', '-c', code]
        found.append(subprocess.check_output(command, env=env, text=True))
    assert found == ['0 1\n', '1 0\n', '0 1\n']


def test_a_cache_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / 'file').touch()
    with (
        pytest.raises(ParameterError, match='cannot be kept, every start compiles them again'),
        KernelCache(tmp_path / 'file').locked(),
    ):
        pass


def test_without_any_folder_kernels_are_compiled_and_not_kept(monkeypatch):
    njit = numba.njit

    def without_folder(function, *, cache=False, **options):
        if cache:
            raise RuntimeError('no locator available')
        return njit(function, **options)

    monkeypatch.setattr(numba, 'njit', without_folder)
    assert kernel_cache.kernel(lambda x: x + 1)(1) == 2


def test_only_one_compiles_at_a_time(tmp_path):
    folder = tmp_path / 'not yet there'
    with (
        KernelCache(folder).locked(),
        (folder / 'kernels.lock').open() as other,
        pytest.raises(BlockingIOError),
    ):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with (folder / 'kernels.lock').open() as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_every_kernel_of_the_package_is_counted():
    from anser_ros.metal import scattering
    from anser_ros.refit import live_refit  # noqa: F401
    from anser_ros.signals import repetition  # noqa: F401
    from anser_ros.tracking import tracker  # noqa: F401

    assert scattering
    cache = KernelCache()
    modules = [module for name, module in sys.modules.items() if name.startswith('anser_ros.')]
    found = [v for module in modules for v in vars(module).values() if isinstance(v, Dispatcher)]
    alone = {kernel.py_func for kernel in found if 'inline' not in kernel.targetoptions}
    own = [kernel for kernel in alone if '<locals>' not in kernel.__qualname__]
    assert len(own) <= cache.total <= len(own) + 5


@pytest.mark.processes
def test_a_kernel_that_does_not_compile_is_said(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(kernel_cache, 'kept_folder', lambda: tmp_path)

    @contextlib.contextmanager
    def failing():
        text = 'import sys; sys.exit("first line\\nno compiler")'
        yield [subprocess.Popen([sys.executable, '-c', text], stderr=subprocess.PIPE, text=True)]

    monkeypatch.setattr(kernel_cache, '_processes', failing)
    with pytest.raises(ParameterError, match='no compiler'):
        kernel_cache.compile_kernels(said.append)
    assert not KernelCache(tmp_path).is_full
    assert said == [f'compiling {KernelCache(tmp_path).total} kernels, once after an installation']


def test_nothing_is_said_where_all_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, 'kept_folder', lambda: tmp_path)
    KernelCache(tmp_path).finish()
    kernel_cache.compile_kernels(pytest.fail)


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
