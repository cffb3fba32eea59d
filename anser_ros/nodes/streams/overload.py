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


class Load:
    """Finds words for what was skipped since one asked last, from the counters of a node."""

    def __init__(self) -> None:
        self._counted = 0, 0

    def words(self, skipped: int, worked: int) -> str:
        """Return what `too_slow` says of the frames since the last call.

        Parameters
        ----------
        skipped, worked : int
            Frames that gave way, and that were worked on, since the start.
        """
        before, self._counted = self._counted, (skipped, worked)
        return too_slow(skipped - before[0], worked - before[1])
