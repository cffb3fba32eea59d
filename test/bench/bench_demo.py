"""The demo: two chains, simulated unit, recorder and monitor; how late, how many, how old.

All figures are from the bag that the demo records itself: when a pose was recorded less the end of
the window that its stamp stands for. The disc comes and goes meanwhile. A recorded window without
a pose of a coil or of the body has an infinite latency; the first seconds are left out. A demo
before it fills the caches: a first start has no poses while the refit's tables are made.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator

import harness
import numpy as np

from anser_ros.apps.dashboard.cli.demo import FROZEN
from anser_ros.stamps import NANO, SECOND_NS, stamp_of
from anser_ros.wire.bag import MessageDecoder, Salvage, iter_messages

FILLING_S, DURATION_S = 15.0, 30.0
"""Time of the demo that fills the caches, and of the one that is measured, s."""
FIRST_S = 3.0
"""Time from the first pose on, s, whose poses do not count."""
WINDOW_S = 0.02
FLUX = '/anser/tool/flux'
TRACKER, OTHERS = 'anser/tracker', f'/anser/{FROZEN}/'
"""The tracker whose poses count, and how the topics of the other chain begin."""


def rows() -> Iterator[harness.Row]:
    """Yield the rows of the benchmark table."""
    with tempfile.TemporaryDirectory() as folder:
        _run(folder, FILLING_S)
        windows, poses, ages = _told(_run(folder, DURATION_S))
    begin = min(min(one) for one in poses.values()) + round(FIRST_S * SECOND_NS)
    end = max(max(one) for one in poses.values())
    counted = [stamp for stamp in windows if begin <= stamp <= end]
    late = np.array(
        [
            [1e3 * ((one.get(stamp, np.inf) - stamp) * NANO - WINDOW_S / 2) for stamp in counted]
            for one in poses.values()
        ]
    )
    what = (
        f'demo, {len(poses)} poses a window, metal comes and goes, after the first {FIRST_S:g} s'
    )
    for share, key in ((50, 'p50'), (99, 'p99'), (100, 'max')):
        yield harness.row(
            f'{what}: {key}', float(np.percentile(late, share, method='higher')), 'ms',
            target=40.0 if key == 'p99' else None,
        )  # fmt: skip
    yield harness.row(f'{what}: lost, of {late.size}', float(np.isinf(late).sum()), target=0.0)
    yield harness.row(
        'demo: age of the model that poses used, of each second the largest, 99 %',
        1e3 * float(np.percentile([a for at, a in ages if at >= begin * NANO], 99)),
        'ms',
        target=40.0,
    )


def _run(folder: str, seconds: float) -> str:
    """Run the demo and return its bag."""
    options = ('--duration', f'{seconds:g}', '--out', folder)
    done = harness.anser('demo', '--json', *options)
    return str(json.loads(done.printed)['bag'])


def _told(bag: str) -> tuple[list[int], dict[str, dict[int, int]], list[tuple[float, float]]]:
    """Return the windows' stamps, ns; when poses were recorded, by topic and stamp; models' ages.

    Each age, s, is with the time at which it was told, s.
    """
    windows: list[int] = []
    poses: dict[str, dict[int, int]] = {}
    ages: list[tuple[float, float]] = []
    decoder = MessageDecoder()
    for raw in iter_messages(bag, Salvage()):
        is_own = raw.topic.startswith('/anser/') and not raw.topic.startswith(OTHERS)
        if is_own and raw.topic.endswith('/pose'):
            poses.setdefault(raw.topic, {})[stamp_of(decoder.decode(raw))] = raw.log_time_ns
        elif raw.topic == FLUX:
            windows.append(stamp_of(decoder.decode(raw)))
        elif raw.topic == '/diagnostics':
            message = decoder.decode(raw)
            at = NANO * stamp_of(message)
            for status in message.status:
                values = {pair.key: pair.value for pair in status.values}
                with contextlib.suppress(KeyError):
                    if status.name == TRACKER:
                        ages.append((at, float(values['model_age_s_max'])))
    return windows, poses, ages
