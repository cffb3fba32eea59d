"""The demo: two chains, simulated unit, recorder and monitor; how late, how many, how old.

All figures are from the bag that the demo records itself: when a pose was recorded less the end of
the window that its stamp stands for. The disc comes and goes meanwhile. A window without a pose of
a coil or of the body has an infinite latency; the first seconds are left out.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator

import numpy as np

from anser_ros.cli.demo_report import FROZEN
from anser_ros.stamps import NANO, SECOND_NS
from anser_ros.wire.bag import MessageDecoder, Salvage, iter_messages

DURATION_S = 30.0
FIRST_S = 3.0
"""Time from the first pose on, s, whose poses do not count."""
RATE_HZ, WINDOW_S = 50.0, 0.02
TRACKER, OTHERS = 'anser/tracker', f'/anser/{FROZEN}/'
"""The tracker whose poses count, and how the topics of the other chain begin."""


def rows() -> Iterator[dict]:
    """Yield the rows of the benchmark table."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', 'demo', '--json']
        options = ['--duration', f'{DURATION_S:g}', '--no-picture', '--out', folder]
        done = subprocess.run([*command, *options], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr)
        poses, ages = _told(json.loads(done.stdout)['bag'])
    begin = min(min(one) for one in poses.values()) + round(FIRST_S * SECOND_NS)
    end = max(max(one) for one in poses.values())
    many = round((end - begin) * NANO * RATE_HZ) + 1
    late = np.full((len(poses), many), np.inf)
    for row, one in enumerate(poses.values()):
        counted = [(stamp, logged) for stamp, logged in one.items() if begin <= stamp <= end]
        late[row, : len(counted)] = [
            1e3 * ((logged - stamp) * NANO - WINDOW_S / 2) for stamp, logged in counted
        ]
    what = (
        f'demo, {len(poses)} poses a window, metal comes and goes, after the first {FIRST_S:g} s'
    )
    for share, key in ((50, 'p50'), (99, 'p99'), (100, 'max')):
        yield {
            'name': f'{what}: {key}',
            'value': float(np.percentile(late, share, method='higher')),
            'unit': 'ms',
            'target': 40.0 if key == 'p99' else None,
        }
    yield {
        'name': f'{what}: lost, of {late.size}',
        'value': float(np.isinf(late).sum()),
        'unit': '',
        'target': 0.0,
    }
    yield {
        'name': 'demo: age of the model that poses used, of each second the largest, 99 %',
        'value': 1e3 * float(np.percentile([a for at, a in ages if at >= begin * NANO], 99)),
        'unit': 'ms',
        'target': 40.0,
    }


def _told(bag: str) -> tuple[dict[str, dict[int, int]], list[tuple[float, float]]]:
    """Return when poses were recorded by topic and stamp, ns, and ages of models (s, s)."""
    poses: dict[str, dict[int, int]] = {}
    ages: list[tuple[float, float]] = []
    decoder = MessageDecoder()
    for raw in iter_messages(bag, Salvage()):
        is_own = raw.topic.startswith('/anser/') and not raw.topic.startswith(OTHERS)
        if is_own and raw.topic.endswith('/pose'):
            stamp = decoder.decode(raw).header.stamp
            of_topic = poses.setdefault(raw.topic, {})
            of_topic[stamp.sec * SECOND_NS + stamp.nanosec] = raw.log_time_ns
        elif raw.topic == '/diagnostics':
            message = decoder.decode(raw)
            at = message.header.stamp.sec + NANO * message.header.stamp.nanosec
            for status in message.status:
                values = {pair.key: pair.value for pair in status.values}
                with contextlib.suppress(KeyError):
                    if status.name == TRACKER:
                        ages.append((at, float(values['model_age_s_max'])))
    return poses, ages


if __name__ == '__main__':
    for row in rows():
        print(row)
