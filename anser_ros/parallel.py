"""Shares this machine: work among threads, and names that one process has at a time.

Pieces of work are the same for any number of threads, and results are taken in their order, so
they are the same bit by bit. Threads help if the pieces are compiled code or large arrays, which
let other threads run meanwhile.
"""

import ctypes
import hashlib
import os
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from typing import TypeVar

Piece = TypeVar('Piece')
Result = TypeVar('Result')

ONE_THREAD = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')
"""Variables that give BLAS one thread, if set before numpy is imported; its matrices are small."""
TURN_S = 1e-4
"""Longest that a thread waits for the interpreter, s, while others work in Python: about a call of
numpy. With Python's 5 ms two threads of a diagnosis are no faster than one; with 1 ms the slowest
hundredth of the poses of `live` came 29 to 62 ms late on a busy computer, with this 20 to 27."""
KEEP_MEMORY = {-1: 2**31 - 1, -4: 0, -8: 1}
"""The GNU C library's mallopt: freed bytes kept, arrays with pages of their own, arenas. New pages
take a tenth of the time."""
_THIS = threading.local()


def cores() -> int:
    """Return how many processor cores this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def shared_among(count: int) -> Iterator[None]:
    """Share work among so many threads for as long as the context lasts.

    Otherwise one thread does all the work, because nodes share their cores with other nodes.
    """
    before, _Workers.count = _Workers.count, max(1, count)
    try:
        yield
    finally:
        _Workers.count = before


def prepare_process() -> None:
    """Have threads wait shortly for each other, and keep the memory that large arrays free."""
    sys.setswitchinterval(TURN_S)
    with suppress(AttributeError):  # another C library
        for option, value in KEEP_MEMORY.items():
            ctypes.CDLL(None).mallopt(option, value)


class _Workers:
    """How many threads share the work."""

    count = 1


def sharing() -> int:
    """Return how many threads share the work."""
    return _Workers.count


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix='piece')


def in_order(work: Callable[[Piece], Result], pieces: Iterable[Piece]) -> list[Result]:
    """Return the results of all pieces, in their order.

    The caller works too. Work inside a piece is not divided again: a piece that waits for others
    may hold what they need.
    """
    whole, most = list(pieces), _Workers.count
    if most == 1 or len(whole) < 2 or getattr(_THIS, 'is_busy', False):
        return [work(piece) for piece in whole]
    left, found = iter(range(len(whole))), {}

    def help_out() -> None:
        _THIS.is_busy = True
        try:
            for index in left:
                found[index] = work(whole[index])
        finally:
            _THIS.is_busy = False

    helpers = [_threads(most - 1).submit(help_out) for _ in range(min(most, len(whole)) - 1)]
    try:
        help_out()
    finally:
        for helper in helpers:
            if not helper.cancel():  # one that has not begun is not waited for
                helper.result()
    return [found[index] for index in range(len(whole))]


def slices(count: int, size: int) -> list[slice]:
    """Return the slices of so many rows, each but the last of one size."""
    return slices_of(slice(0, count), size)


def slices_of(whole: slice, size: int) -> list[slice]:
    """Return the slices of a slice of known ends, each but the last of one size."""
    starts = range(whole.start, whole.stop, size)
    return [slice(start, min(start + size, whole.stop)) for start in starts]


def hold(name: str) -> socket.socket | None:
    """Take a name, and return what holds it until it is closed; None when another one has it.

    The name is that of a socket without a file (Linux): the system gives it back when the process
    ends, however it does, and users of any name see each other's.
    """
    holder = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        # A path may be longer than a socket's name.
        holder.bind(f'\0anser_ros_{hashlib.sha256(name.encode()).hexdigest()}')
    except OSError:
        holder.close()
        return None
    return holder
