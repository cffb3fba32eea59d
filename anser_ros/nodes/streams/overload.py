"""Reports when a computer is too slow for the frames that it receives."""

import os


def too_slow(skipped: int, worked: int) -> str:
    """Return what part of the windows since the last look gave way to newer ones; empty for none.

    The load is the system's own mean over the last minute, in processes that need a core; the
    number of cores is given with it.
    """
    if not skipped:
        return ''
    share = 100 * skipped / (skipped + worked)
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    percent = f'{share:.0f} %' if share >= 1 else 'less than 1 %'
    return f'computer too slow: {percent} of windows skipped, load {load:.1f} on {cores} cores'
