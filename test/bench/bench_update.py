"""Time of an update of the refit, on the clock, over a minute of metal that never rests.

The disc of the live chain's benchmark comes and goes over the demo's board; a frame every 20 ms,
as a live node has it, in one thread beside which the refit's own background work goes on. Every
frame counts from the first on.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import harness
import numpy as np
from live_chain import METAL_FROM_S, world

from anser_ros.refit.live_refit import LiveRefit
from anser_ros.sessions.nominal_board import NominalBoard, stated_volume
from anser_ros.sessions.session import sensor_table
from anser_ros.sessions.starting_model import load_model
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.text_files import config_path

SECONDS, FRAME_S = 60.0, 0.02
TARGETS_MS = {50: None, 99: 3.0, 100: 6.0}
"""Largest time, ms, that is aimed at, by share of the frames in per cent."""


def rows() -> Iterator[harness.Row]:
    """Yield the rows of the benchmark table."""
    scene, rng = world(True), np.random.default_rng(1)
    setup = scene.setup
    first, noise_t = len(setup.tool_sensors), setup.refit.accuracy.flux_noise_t
    clean = scene.flux(0.0)[first:]
    times = METAL_FROM_S + FRAME_S * np.arange(round(SECONDS / FRAME_S))
    frames = [scene.flux(float(t))[first:] for t in times]
    references = sensor_table(setup.reference_sensors)
    model, drawing = load_model(config_path('demo_model.yaml')), NominalBoard.of(setup).field
    volume = stated_volume(setup)
    refit = LiveRefit(model, references, clean, setup.refit, drawing, volume=volume)
    spent, due = [], time.monotonic()
    for number, flux in enumerate(frames):
        noise = noise_t * rng.standard_normal((*flux.shape, 2)) @ [1.0, 1.0j]
        due += FRAME_S
        time.sleep(max(due - time.monotonic(), 0.0))
        begin = time.perf_counter()
        stamp_ns = SECOND_NS + round(number * FRAME_S * SECOND_NS)
        refit.update(stamp_ns, references.channel, flux + noise)
        spent.append(1e3 * (time.perf_counter() - begin))
    shape = f'{len(references)} references x {flux.shape[1]} emitters'
    for share, target in TARGETS_MS.items():
        key = 'longest' if share == 100 else f'{share} %'
        yield harness.row(
            f'update on the clock, {shape}, metal moving for {SECONDS:g} s: {key}',
            float(np.percentile(spent, share, method='higher')), 'ms', target=target,
        )  # fmt: skip
