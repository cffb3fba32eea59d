"""Starts a node for the first time after an installation: it waits until kernels are compiled."""

import subprocess
import sys
import time
from collections.abc import Callable

from anser_ros.kernel_cache import KernelCache

POLL_S = 0.1
"""Time from one look at the compiling process to the next, s."""
LINE_INTERVAL_S = 1.0
"""Time from one line about the progress to the next, s."""


def wait_for_kernels(say: Callable[[str], None]) -> str:
    """Have all kernels compiled if they are not; return why it failed, empty when all is there.

    Of nodes that start together one process compiles, and the others wait for it. ``say`` gets a
    line at once and every second, none where all kernels are there.
    """
    cache = KernelCache()
    if cache.is_full:
        return ''
    command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', 'warm_up']
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    shown_s = -LINE_INTERVAL_S
    try:
        while process.poll() is None:
            if time.monotonic() - shown_s >= LINE_INTERVAL_S:
                shown_s = time.monotonic()
                say(
                    f'compiling kernels, once after an installation: {cache.done} of {cache.total}'
                )
            time.sleep(POLL_S)
    finally:
        if process.poll() is None:
            process.terminate()
        words = process.communicate()[1].strip().splitlines()
    return (words or ['no kernels'])[-1] if process.returncode else ''
