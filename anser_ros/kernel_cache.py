"""Compiles kernels once for all copies of the package, and knows whether they are on disk.

Numba keeps what it has compiled beside the source file. So that a clone, an installation and the
copy that ``colcon build`` makes of it share it, `kernel` has numba believe that the source files
are copies of them, in a folder of the user's cache whose name is a digest of their contents.

With an empty cache every process compiles all that it needs, processes that start together each
the same. So one of them compiles everything under a lock, reports its progress, and leaves a mark
when all kernels are there.
"""

import contextlib
import fcntl
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core.registry import cpu_target

from anser_ros.errors import ParameterError

PACKAGE = Path(__file__).parent
_CONFIG: Any = numba.config
DECORATOR, PART = b'\n@kernel', b'\n@inlined'
"""What stands before every kernel, and before every function that is a part of kernels."""
MOST_STATES = 4
"""States of the sources whose kernels are kept, the last compiled: each has about 10 MB."""


def kernel(function: Any = None, **options: Any) -> Any:
    """Compile a function by numba, with a quotient by zero as numpy has it, and keep the result.

    Further options, with which the decorator is called, are those of ``numba.njit``.
    """
    if function is None:
        return functools.partial(kernel, **options)
    folder, code = kept_folder(), function.__code__
    path = Path(code.co_filename)
    if folder is not None and path.is_relative_to(PACKAGE) and not _CONFIG.DISABLE_JIT:
        copy = folder / path.relative_to(PACKAGE)
        function.__code__ = code.replace(co_filename=str(copy))
    try:
        return numba.njit(function, cache=True, error_model='numpy', **options)
    except RuntimeError:  # no folder can be written, which `KernelCache.locked` reports
        return numba.njit(function, error_model='numpy', **options)


def inlined(function: Any) -> Any:
    """Mark a function that is compiled as a part of each kernel that calls it, never alone."""
    return numba.njit(function, inline='always')


@functools.cache
def kept_folder() -> Path | None:
    """Return the folder of the kernels as their sources are now; None where it cannot be made."""
    home = Path(_CONFIG.CACHE_DIR or os.environ.get('XDG_CACHE_HOME') or '~/.cache')
    folder = home.expanduser() / 'anser_ros' / 'kernels' / _state()[0]
    return folder if folder.is_dir() or _copy_sources(folder) else None


def _copy_sources(folder: Path) -> bool:
    """Copy the kernels' sources at one stroke; another process may do so at the same time."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, ignore_cleanup_errors=True) as name:
            draft = Path(name, folder.name)
            for path in _sources():
                copy = draft / path.relative_to(PACKAGE)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
            draft.rename(folder)
    except OSError:
        return folder.is_dir()
    return True


def _sources() -> dict[Path, bytes]:
    """The text of every source file with kernels or parts of them."""
    texts = {path: path.read_bytes() for path in sorted(PACKAGE.rglob('*.py'))}
    return {path: text for path, text in texts.items() if DECORATOR in text or PART in text}


@functools.cache
def _state() -> tuple[str, int]:
    """A digest of the sources and of what compiles them, and the number of kernels."""
    digest, total = hashlib.sha256(f'{numba.__version__} {platform.python_version()}'.encode()), 0
    for path, text in _sources().items():
        digest.update(str(path.relative_to(PACKAGE)).encode() + text)
        total += text.count(DECORATOR)
    return digest.hexdigest()[:16], total


class KernelCache:
    """Keeps the mark and the lock of one state of the kernels' sources, and counts what is there.

    They are in a folder, by default beside the kernels, of which there are ``total``.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder or kept_folder() or PACKAGE / '__pycache__'
        key, self.total = _state()
        processor = str(cpu_target.target_context.codegen().magic_tuple())
        name = f'{key}_{hashlib.sha256(processor.encode()).hexdigest()[:8]}'
        self._mark = self._folder / f'{name}.ready'
        self._lock = self._folder / 'kernels.lock'

    @property
    def is_full(self) -> bool:
        """Return whether all kernels have been compiled as their sources are now."""
        return self._mark.exists()

    @property
    def done(self) -> int:
        """Return how many kernels are there, by the indices that numba keeps of them."""
        return sum(1 for _ in self._folder.rglob('*.nbi'))

    @contextlib.contextmanager
    def locked(self) -> Iterator[bool]:
        """Be the only process that compiles; False where another one does.

        Raises `ParameterError` when nothing can be written into the cache.
        """
        try:
            self._lock.parent.mkdir(parents=True, exist_ok=True)
            lock = self._lock.open('w')
        except OSError as error:
            raise ParameterError(
                f'compiled kernels cannot be kept, every start compiles them again: '
                f'{self._folder}: {error.strerror}'
            ) from error
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
            else:
                yield True

    def finish(self) -> None:
        """Note that all kernels are there, and remove those of sources that are long gone."""
        self._mark.touch()
        kept = kept_folder()
        if self._folder == kept:
            last = sorted(kept.parent.iterdir(), key=lambda f: f.stat().st_mtime, reverse=True)
            for folder in last[MOST_STATES:]:
                shutil.rmtree(folder, ignore_errors=True)


POLL_S = 0.1
"""Time from one look at the compiling processes to the next, s."""
PARTS = ('coils', 'metal and bodies')
"""What processes compile at the same time, as `cli.warm_up` has it."""


def compile_kernels(
    say: Callable[[str], None],
    is_stopped: Callable[[], bool] = lambda: False,
    interval_s: float = 5.0,
) -> None:
    """Have processes compile all kernels that are not there, or wait for others that do.

    ``say`` gets a line at the start and after each interval; ``is_stopped`` is whether to give up,
    which is no error. Raises `ParameterError` when a process fails, with its last line.
    """
    cache = KernelCache()
    if cache.is_full:
        return
    begin_s = shown_s = time.monotonic()
    words = f'compiling {cache.total} kernels, once after an installation'
    say(words)

    def wait() -> bool:
        nonlocal shown_s
        time.sleep(POLL_S)
        if time.monotonic() - shown_s > interval_s:
            shown_s = time.monotonic()
            say(f'{words}: {cache.done} after {shown_s - begin_s:.0f} s')
        return not is_stopped()

    while not cache.is_full:
        with cache.locked() as is_ours:
            if not is_ours:
                if wait():
                    continue
                return
            with _processes() as running:
                while any(process.poll() is None for process in running):
                    if not wait():
                        return
                for process in running:
                    if process.returncode:
                        lines = process.communicate()[1].splitlines() or ['no word']
                        raise ParameterError(f'kernels cannot be compiled: {lines[-1]}')
            cache.finish()


@contextlib.contextmanager
def _processes() -> Iterator[list['subprocess.Popen[str]']]:
    """Start a process for each part; end those that are left."""
    command = [sys.executable, '-P', '-m', 'anser_ros.cli.warm_up']
    running = [
        subprocess.Popen(
            [*command, part], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True,
        )
        for part in PARTS
    ]  # fmt: skip
    try:
        yield running
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
            process.communicate()
