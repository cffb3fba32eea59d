"""What the integrity checks cost of a tracker's frame: each alone, beside the frame they judge."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import harness
import numpy as np

from anser_ros.frames.intake import Freshness, Intake
from anser_ros.sessions.session import load_session
from anser_ros.tracking import judgement
from anser_ros.tracking.tracker import Tracker

CHECKS = {
    'order, flags and size of the readings': (Intake, 'admit'),
    'freshness': (Freshness, 'judged'),
    'rigidity': (judgement, '_judge_coils'),
    'continuity': (judgement.Judgement, '_judged_in_time'),
    'record of the model': (judgement.Judgement, '_add_to_record'),
}
WHOLE = 'the whole frame'
TARGET_MS = 0.1
WARM_UP = 20
"""Frames that are not counted: tables that are worked out once, and cold solves."""


class Clock:
    """Adds up the processor time (s) that calls of a function take in each frame."""

    def __init__(self) -> None:
        self.frames: list[float] = []

    def timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, whose calls count for the last frame."""

        def call(*given: Any) -> Any:
            start = time.thread_time()
            result = function(*given)
            self.frames[-1] += time.thread_time() - start
            return result

        return call

    def median_ms(self) -> float:
        """Return the median of a frame."""
        return float(1e3 * np.median(self.frames[WARM_UP:]))


def rows() -> Iterator[harness.Row]:
    """Yield the rows of the benchmark table."""
    model = harness.calibrated(load_session(harness.BAGS / 'factory.mcap'))
    tool = load_session(harness.BAGS / 'moving.mcap').tools[0]
    tracker = Tracker(model, tool.sensors)
    clocks = {name: Clock() for name in (WHOLE, *CHECKS)}
    update, tracked, total = clocks[WHOLE].timed(tracker.update), 0, 0
    with contextlib.ExitStack() as patches:
        for check, (owner, name) in CHECKS.items():
            function = clocks[check].timed(getattr(owner, name))
            patches.enter_context(mock.patch.object(owner, name, function))
        for seconds, flux in zip(tool.time, tool.flux, strict=True):
            for clock in clocks.values():
                clock.frames.append(0.0)
            poses = update(round(1e9 * (1 + seconds)), tool.sensors.channel, flux)
            tracked, total = tracked + sum(p.state == 'ok' for p in poses), total + len(poses)
    yield harness.row('integrity: poses that are ok', tracked / total, '1')
    for check in CHECKS:
        yield harness.row(
            f'integrity: {check}, 9 coils and a body, a frame, median', clocks[check].median_ms(),
            'ms', target=TARGET_MS, rival=(WHOLE, clocks[WHOLE].median_ms()),
        )  # fmt: skip
