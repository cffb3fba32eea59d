"""Latency, losses, rate and load of the live chain: serial port to PoseStamped elsewhere.

The worst case that users have: the refit in force, metal that never rests, a recorder that writes
everything, 9 + 32 channels. Beside it, in the same run: the same chain as three processes, with a
model that stays as it was, and without metal; and the floor of the middleware, a node that reads
the port and publishes a pose without any mathematics.
"""

from __future__ import annotations

from collections.abc import Iterator

import harness
import numpy as np
from live_chain import METAL_FROM_S, SETTLE_S, TOOL_SENSORS, Layout, Run, made_bytes, run_chain

LONG_S, SHORT_S = 60.0, 15.0
"""Time that the case of interest is measured, s, and each of those beside it."""
START_S = 12.0
"""Time, s, in which nodes start with compiled kernels: bytes are made for as long."""
RATES_HZ = (400.0, 200.0, 100.0)
RATIOS_TO_FLOOR = (
    ('one', 'one process, p50', 50.0, 2.2),
    ('one', 'one process, p99', 99.0, 4.0),
    ('apart', 'three processes, p50', 50.0, 4.0),
)
"""Run, words, percentile, and the largest ratio that is aimed at."""
BUSY_MS = 3.0
"""Lateness of the bytes themselves, ms, beyond which the machine was busy with something else."""


def rows() -> Iterator[harness.Row]:
    """Yield the rows of the benchmark table."""
    lead_s = START_S + SETTLE_S + 1.0
    metal = made_bytes(True, METAL_FROM_S + lead_s + LONG_S)
    clear = made_bytes(False, lead_s + SHORT_S)
    floor = run_chain(Layout(is_floor=True, metal=False), clear, SHORT_S)
    floors = Layout(is_floor=True, metal=False, floor_poses=TOOL_SENSORS)
    as_many = run_chain(floors, clear, SHORT_S)
    frozen = run_chain(Layout(follows=False), metal, SHORT_S)
    apart = run_chain(Layout(composed=False), metal, SHORT_S)
    one = run_chain(Layout(), metal, LONG_S)
    quiet = run_chain(Layout(follows=False, metal=False), clear, SHORT_S)
    moving = 'refit in force, metal moving, recorder on, 9 + 32 channels at 50 Hz'
    busy = _busy(one)
    yield from _latencies(f'live in one process, {moving}{busy}', one, frozen, 'frozen model')
    yield from _latencies(f'three processes, {moving}{_busy(apart)}', apart, floor, 'floor')
    what = 'live in one process, no metal, model as calibrated'
    yield from _latencies(f'{what}{_busy(quiet)}', quiet, floor, 'floor')
    for run, what, share, target in RATIOS_TO_FLOOR:
        ratio = {'one': one, 'apart': apart}[run].percentile(share) / as_many.percentile(share)
        name = f'{what} over that of a node that reads the port and publishes as many poses'
        yield harness.row(name, ratio, target=target)
    if one.ages_s.size:
        # Of each second the largest; stamps jitter by microseconds, so windows are counted.
        windows = np.rint(one.ages_s * Layout().rate_hz)
        yield harness.row(
            'age of the model that poses used, 99 % of 60 s, one process',
            float(np.percentile(windows, 99)), 'windows', target=1.0,
        )  # fmt: skip
        yield harness.row(
            'age of the model that poses used, the largest of 60 s, one process',
            1e3 * float(one.ages_s.max()),
            'ms',
            rival=(
                'three processes',
                1e3 * float(apart.ages_s.max()) if apart.ages_s.size else None,
            ),
        )
    for run, name in ((one, 'one process'), (apart, 'three processes')):
        parts = ', '.join(f'{who} {100 * share:.0f}' for who, share in sorted(run.load.items()))
        yield harness.row(
            f'CPU at 50 Hz, metal moving, {name}', 100 * sum(run.load.values()),
            f'% of a core ({parts})', target=60.0,
        )  # fmt: skip
    yield harness.row(
        'rate without a lost window, no metal, one process', _sustained_hz(clear), 'Hz',
        rival=('usual rate', 50.0), target=400.0, target_is='least',
    )  # fmt: skip


TARGETS = {'p50': (50.0, 2.5), 'p99': (99.0, 6.0), 'max': (100.0, None)}
"""Percentiles of the latency, and the ms that are aimed at."""


def _latencies(what: str, run: Run, rival: Run, name: str) -> Iterator[harness.Row]:
    """Yield the rows of one case beside a rival; a window without a pose counts as infinite."""
    for key, (share, target) in TARGETS.items():
        ours, other = run.percentile(share), (name, rival.percentile(share))
        yield harness.row(f'{what}: {key}', ours, 'ms', other, target=target)
    yield harness.row(
        f'{what}: windows of a sensor without a pose, of {run.latency_ms.size}', float(run.lost),
        rival=(name, float(rival.lost)), target=0.0,
    )  # fmt: skip


def _busy(run: Run) -> str:
    """Report that the machine was busy: latencies say more of that than of the chain."""
    late = run.device_late_ms
    return f' (machine busy: the bytes themselves {late:.0f} ms late)' if late > BUSY_MS else ''


def _sustained_hz(clear: list[bytes]) -> float:
    """The highest rate at which every window gave all its poses."""
    for rate_hz in RATES_HZ:
        layout = Layout(rate_hz=rate_hz, follows=False, metal=False)
        if run_chain(layout, clear, SHORT_S).lost == 0:
            return rate_hz
    return 50.0
