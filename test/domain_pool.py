"""ROS domains that test runs on one machine share without ever meeting."""

import contextlib
import fcntl
import os
import random
import tempfile
from collections.abc import Sequence
from pathlib import Path

# Domains up to 101 leave all of Linux's ephemeral ports alone.
DOMAINS = range(1, 101)
# What one run keeps at most, so that a few can run beside each other.
MOST_DOMAINS = 20
FOLDER = Path(tempfile.gettempdir()) / 'anser_ros_test_domains'


class DomainPool:
    """Gives out ROS domains that no other test run on this machine has at that time.

    A domain belongs to whoever has its file in the folder locked; the system takes the lock off
    a run that was killed. A run keeps the domains that it has had, so that late words of an
    earlier test's processes never reach another run, and begins anew with its own when all are
    taken.
    """

    def __init__(self, folder: Path = FOLDER, domains: Sequence[int] = DOMAINS) -> None:
        self._folder = folder
        self._free = list(domains)
        random.shuffle(self._free)
        self._ours: list[int] = []
        self._locks: dict[int, int] = {}
        self._turn = 0
        folder.mkdir(exist_ok=True)
        with contextlib.suppress(PermissionError):  # another user's, who let everybody in
            folder.chmod(0o777)

    def take(self) -> int:
        """Return a domain of this run: a new one while there are any, then its oldest again."""
        while self._free and len(self._ours) < MOST_DOMAINS:
            number = self._free.pop()
            if self._lock(number):
                self._ours.append(number)
                return number
        if not self._ours:
            raise RuntimeError(f'all ROS domains are taken by other runs (locks: {self._folder})')
        self._turn += 1
        return self._ours[(self._turn - 1) % len(self._ours)]

    def close(self) -> None:
        """Give all back."""
        while self._locks:
            os.close(self._locks.popitem()[1])
        self._ours.clear()

    def _lock(self, number: int) -> bool:
        # To read is enough for a lock, and another user's files allow no more.
        lock = os.open(self._folder / f'{number}', os.O_CREAT | os.O_RDONLY, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            return False
        self._locks[number] = lock
        return True
