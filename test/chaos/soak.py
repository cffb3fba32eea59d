"""Lets the chain run for long while metal comes and goes and the cable is pulled out every minute.

Memory, files, threads and latency of every node are looked at once a second, after the time in
which everything is used for the first time. A node that grows by more than is allowed fails.
"""

import argparse
import contextlib
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rig import Rig, domain_pool

GROWTH_MB = 5.0
"""Most that a node may grow in an hour, MB."""
WARM_SHARE, LONGEST_WARM_S = 0.25, 300.0
"""Share of the time, and longest time, s, before which nothing counts: caches fill, and what is
used once a minute is used for the first time."""
UNPLUG_EVERY_S, UNPLUGGED_S = 60.0, 2.0
"""Time from one unplugging to the next, and how long the cable is out, s."""
HOUR_S = 3600.0
"""Seconds in an hour."""
OWN = 'RssAnon', 'RssShmem', 'VmSwap'
"""What counts as a node's own memory, by its names in /proc: its blocks, what it shares with other
processes through the middleware, and what of them is on disk."""


@dataclass
class Series:
    """What was seen of one node: time (s), its own memory (MB), open files, threads.

    Pages of files (programs, compiled kernels) are not its own: the system takes idle ones away
    and brings them back, which is no growth.
    """

    rows: list[tuple[float, float, int, int]] = field(default_factory=list)

    def note(self, time_s: float, pid: int) -> None:
        """Look at the process."""
        process = Path(f'/proc/{pid}')
        status = dict(line.split(':', 1) for line in (process / 'status').read_text().splitlines())
        memory = sum(1.024e-3 * int(status[key].split()[0]) for key in OWN)
        files = len(list((process / 'fd').iterdir()))
        threads = len(list((process / 'task').iterdir()))
        self.rows.append((time_s, memory, files, threads))

    def hourly(self, column: int) -> tuple[float, float]:
        """Return the growth of a column in an hour, and its standard error.

        The line is Theil and Sen's, the median slope between points that are half of the time
        apart, as a step of the allocator must not pass for a trend; the error is the median
        deviation of these slopes over the root of their number of independent minutes.
        """
        table = np.array([(row[0], row[column]) for row in self.rows], dtype=float)
        half = len(table) // 2
        if half < 2:
            return float('nan'), float('nan')
        early, late = table[:half], table[-half:]
        slopes = (late[:, 1] - early[:, 1]) / (late[:, 0] - early[:, 0]) * HOUR_S
        middle = float(np.median(slopes))
        spread = 1.4826 * float(np.median(np.abs(slopes - middle)))
        return middle, spread / np.sqrt(max(1.0, (table[-1, 0] - table[0, 0]) / 60.0))


def watched(rig: Rig, seconds: float) -> tuple[dict[str, Series], np.ndarray]:
    """Let the chain run; return what was seen of each node, and (time, latency) rows, s."""
    begin = time.monotonic()
    warm = min(WARM_SHARE * seconds, LONGEST_WARM_S)
    series = {name: Series() for name in rig.children}
    latencies: list[tuple[float, float]] = []
    unplug = begin + 0.5 * UNPLUG_EVERY_S
    offset = time.time() - time.monotonic()
    while (now := time.monotonic()) < begin + seconds:
        if crashed := rig.crashed():
            raise RuntimeError('; '.join(crashed))
        if now > unplug:
            rig.line.unplug()
            time.sleep(UNPLUGGED_S)
            rig.line.plug()
            unplug += UNPLUG_EVERY_S
        if now > begin + warm:
            for name, one in series.items():
                one.note(now - begin, rig.pid(name))
            some = [p.arrival_s + offset - p.stamp_s for p in rig.witness.poses]
            if some:
                latencies.append((now - begin, float(np.median(some))))
        rig.witness.poses.clear()  # the watcher must not grow either
        rig.witness.states.clear()
        rig.witness.forget_truth()
        time.sleep(1.0)
    return series, np.array(latencies).reshape(-1, 2)


def main() -> int:
    """Run the soak; 1 when a node grows by more than it may, or ends."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument('--duration', type=float, default=300.0, help='s')
    args = parser.parse_args()
    if args.duration < 20.0:
        print('soak: --duration must be at least 20 s', file=sys.stderr)
        return 2
    with (
        tempfile.TemporaryDirectory(prefix='anser_soak_') as folder,
        domain_pool() as domains,
        contextlib.closing(Rig(Path(folder), domains.take(), 'metal')) as rig,
    ):
        rig.start('recorder', directory=folder)
        time.sleep(3.0)
        series, latencies = watched(rig, args.duration)
    return report(series, latencies)


def report(series: dict[str, Series], latencies: np.ndarray) -> int:
    """Print the table; 1 when a node grows by more than it may."""
    failed = False
    minutes = (latencies[-1, 0] - latencies[0, 0]) / 60.0 if len(latencies) else 0.0
    print(
        f'{"node":14} {"MB":>6} {"MB an hour":>18} {"files an hour":>14} {"threads an hour":>16}'
    )
    for name, one in series.items():
        (growth, error), files, threads = (one.hourly(column) for column in (1, 2, 3))
        bad = growth - 2.0 * error > GROWTH_MB
        failed |= bad
        print(
            f'{name:14} {one.rows[-1][1]:6.0f} {growth:9.1f} +- {error:5.1f} {files[0]:14.1f} '
            f'{threads[0]:16.1f}{"  TOO MUCH" if bad else ""}'
        )
    if len(latencies) > 1:
        print(f'latency from the middle of a window: {1e3 * np.median(latencies[:, 1]):.1f} ms')
    print(f'slopes over {minutes:.1f} minutes, times the hour they were not watched for')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
