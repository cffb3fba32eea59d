"""Knows whether the compiled kernels are on disk, and who compiles them: shared by all processes.

Numba keeps what it has compiled beside the source files, or in the user's cache. With an empty
cache every process compiles all that it needs, processes that start together each the same. So one
of them compiles everything under a lock, reports its progress, and leaves a mark when all kernels
are there.
"""

import contextlib
import fcntl
import hashlib
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core.registry import cpu_target

PACKAGE = Path(__file__).parent
DECORATOR = '@numba.njit'
"""What stands before every kernel."""


class KernelCache:
    """Keeps the mark, the lock and the progress of one state of the kernels' sources.

    Parameters
    ----------
    folder : Path
        Where the mark is kept: a folder in which numba keeps compiled kernels, see `folder_of`.

    Attributes
    ----------
    total : int
        How many kernels the package has.
    """

    def __init__(self, folder: Path) -> None:
        processor = cpu_target.target_context.codegen().magic_tuple()
        state = [numba.__version__, platform.python_version(), str(processor)]
        self.total = 0
        for path in sorted(PACKAGE.rglob('*.py')):
            count = path.read_text(encoding='utf-8').count(f'\n{DECORATOR}')
            if count:
                self.total += count
                stat = path.stat()  # what numba itself knows a changed source by
                state.append(f'{path} {stat.st_mtime_ns} {stat.st_size}')
        key = hashlib.sha256('\n'.join(state).encode()).hexdigest()[:16]
        self._mark = folder / f'kernels_{key}.ready'
        self._progress = folder / f'kernels_{key}.progress'
        self._lock = folder / 'kernels.lock'

    @property
    def is_full(self) -> bool:
        """Return whether all kernels have been compiled as their sources are now."""
        return self._mark.exists()

    @property
    def done(self) -> int:
        """Return how many kernels are known to be there."""
        try:
            return len(set(self._progress.read_text(encoding='utf-8').split()))
        except FileNotFoundError:
            return 0

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Be the only process that compiles; wait for another one that does."""
        self._lock.parent.mkdir(parents=True, exist_ok=True)
        with self._lock.open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield

    def begin(self) -> None:
        """Forget how far an earlier attempt came."""
        self._progress.unlink(missing_ok=True)

    def add(self, name: str) -> None:
        """Note a kernel that is there; processes may do so at the same time."""
        with self._progress.open('a', encoding='utf-8') as file:
            file.write(f'{name}\n')

    def finish(self) -> None:
        """Note that all kernels are there."""
        self._mark.touch()
        self._progress.unlink(missing_ok=True)


def folder_of(kernel: Any) -> Path:
    """Return the folder in which numba keeps a kernel that it has compiled."""
    return Path(kernel.stats.cache_path)
