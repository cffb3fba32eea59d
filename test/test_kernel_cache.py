"""Kernels are compiled once: the mark, the lock, the progress, and what a failure says."""

import contextlib
import fcntl
import os
import shutil
import subprocess
import sys

import pytest

from anser_ros import kernel_cache
from anser_ros.cli import warm_up
from anser_ros.errors import ParameterError
from anser_ros.frames.intake import fill_frame
from anser_ros.kernel_cache import PACKAGE, KernelCache, folder_of


def test_it_is_full_when_all_has_been_compiled(tmp_path):
    cache = KernelCache(tmp_path)
    cache.begin()
    assert not cache.is_full
    assert cache.done == 0
    for name in ('a', 'b', 'a'):
        KernelCache(tmp_path).add(name)
    assert cache.done == 2
    cache.finish()
    assert KernelCache(tmp_path).is_full


def test_a_changed_source_empties_it(tmp_path, monkeypatch):
    """As for numba, it is the time of a file that tells; the package's own are in use."""
    package = tmp_path / 'package'
    package.mkdir()
    source = shutil.copy2(PACKAGE / 'frames' / 'intake.py', package)
    monkeypatch.setattr(kernel_cache, 'PACKAGE', package)
    KernelCache(tmp_path).finish()
    before = os.stat(source)
    os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    assert not KernelCache(tmp_path).is_full
    os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert KernelCache(tmp_path).is_full


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
    cache = KernelCache(folder_of(fill_frame))
    own = [name for name in warm_up.kernels() if '<locals>' not in name]
    assert len(own) <= cache.total <= len(own) + 5


@pytest.mark.processes
def test_a_kernel_that_does_not_compile_is_said(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(warm_up, 'folder_of', lambda _: tmp_path)

    @contextlib.contextmanager
    def failing():
        text = 'import sys; sys.exit("first line\\nno compiler")'
        yield [subprocess.Popen([sys.executable, '-c', text], stderr=subprocess.PIPE, text=True)]

    monkeypatch.setattr(warm_up, '_processes', failing)
    with pytest.raises(ParameterError, match='no compiler'):
        warm_up.compile_kernels(said.append)
    assert not KernelCache(tmp_path).is_full
    assert said == [f'compiling {KernelCache(tmp_path).total} kernels, once after an installation']


def test_nothing_is_said_where_all_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(warm_up, 'folder_of', lambda _: tmp_path)
    KernelCache(tmp_path).finish()
    warm_up.compile_kernels(pytest.fail)
