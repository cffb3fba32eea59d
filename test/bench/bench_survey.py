"""How well a scan tells its own errors: simulated scans by a hand, on seeds that chose nothing.

Eight emitters of seven random dipoles each, no drawing. The tool's coils are tracked singly on a
path that the scan did not take, and their exact error is compared with that of a scan by a perfect
tool and a camera that only jitters; the table is in docs/calibration.md.

    python test/bench/bench_survey.py [--rows 0 3] [--seeds 701 702] [--json lines.json]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import harness
import numpy as np
from calibration_world import JITTER_M, NOISE_T, Errors, hand, moved_scan, scene, tool_of

from anser_ros.calibration.calibrate import Options, correct_scan, fit_scan
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.tracker import Tracker

SEEDS = (701,)
"""No seed below 500 is used here: those of the tests, and the one that a mend was made on, are."""
ROWS = (
    (9, 20.0, 34.0, Errors()),
    (5, 90.0, 34.0, Errors()),
    (2, 90.0, 34.0, Errors()),
    (1, 90.0, 34.0, Errors()),
    (9, 90.0, 1.0, Errors()),
    (9, 60.0, 34.0, Errors(gain=0.001, offset_s=0.0)),
    (9, 60.0, 34.0, Errors(gain=0.02, offset_s=0.04)),
    (5, 300.0, 34.0, Errors()),
    (5, 60.0, 34.0, Errors(jitter=0.3)),
    (5, 60.0, 34.0, Errors(jitter=4.3)),
)
"""Coils of the tool, length of the scan (s), turns (deg), and what is wrong with it."""
HEAD = (
    '| coils | scan, s | turns, deg | gains, % | offset, ms | jitter, mm | ours, mm | worst, mm '
    "| over 3 sigma, % | a perfect tool's, mm | reported as undetermined | CPU, s |"
)
CENTRES = np.array([[x, y, 0.0] for x in (-0.09, 0.0, 0.09) for y in (-0.09, 0.0, 0.09) if x or y])
"""Eight coils, since a single coil has five coordinates and every emitter tells one number, m."""
LAYER = Layout('layer', 14, 1.25, 0.0)
"""Both fields are fitted with the same dipoles: the tools' errors are compared, not layouts."""
UNSEEN_S = 700.0
"""The hand's path from this time on is another one than that of any scan."""


def row_of(coils: int, seconds: float, turns_deg: float, errors: Errors, seed: int) -> str:
    """One scan's line of the table of tracked coils."""
    begin = time.process_time()
    ours = _tracked(coils, seconds, turns_deg, errors, seed, KINDS)
    spent = time.process_time() - begin
    sound = Errors(0.0, 0.0, 0.0, (0.0, 0.0, 0.0), 0.0, errors.jitter, 0.0)
    perfect = _tracked(coils, seconds, turns_deg, sound, seed, ())
    values = (
        coils, f'{seconds:g}', f'{turns_deg:g}', f'{100 * errors.gain:g}',
        f'{1e3 * errors.offset_s:g}', f'{1e3 * errors.jitter * JITTER_M:.3f}', f'{ours[0]:.3f}',
        f'{ours[1]:.3f}', f'{ours[2]:.2f}', f'{perfect[0]:.3f}', ours[3] or 'nothing',
        f'{spent:.0f}',
    )  # fmt: skip
    return f'| {" | ".join(map(str, values))} |'


def _tracked(
    coils: int, seconds: float, turns_deg: float, errors: Errors, seed: int, kinds: tuple[str, ...]
) -> tuple[float, float, float, str]:
    """Errors of all coils and of the worst (mm), share over 3 sigma (%), what was not told."""
    rng, turn = np.random.default_rng(seed), np.radians(turns_deg)
    world, table = scene(rng, side=4, centres=CENTRES), tool_of(coils)
    told, truth = moved_scan(world, table, rng, seconds, errors, turn)
    names = tuple(f'coil{k}' for k in range(len(CENTRES)))
    tones = tuple(6000.0 + 170.0 * np.arange(len(CENTRES)))
    options = Options(layout=LAYER, estimate=kinds)
    generator = replace(world.generator, emitters=names, frequencies_hz=tones)
    scan = correct_scan([told], generator, options)
    model = fit_scan(scan, ['scan'], generator, options).model
    at = UNSEEN_S + np.arange(0.0, 20.0, 0.04)
    position, rotation = hand(at, turn)
    points, axes = replace(
        table, position=table.position + truth.place + truth.lever, axis=truth.axis
    ).placed(position, rotation.as_matrix())
    flux = world.flux(points.reshape(-1, 3), axes.reshape(-1, 3)).reshape(at.size, coils, -1)
    flux = flux * truth.gain[:, None]
    flux = flux + NOISE_T * (rng.normal(size=flux.shape) + 1j * rng.normal(size=flux.shape))
    tracker = Tracker(model, table, TrackerSettings(flux_noise_t=NOISE_T))
    squares, over, none = np.zeros((at.size, coils)), 0, np.zeros(coils, dtype=np.int64)
    for i, frame in enumerate(flux):
        found = tracker.update(round(1e9 * at[i]), table.channel, frame, none)
        by_name = {one.name: one for one in found}
        for c, name in enumerate(table.name):
            one = by_name[name]
            error = np.linalg.norm(one.position - points[i, c]) if one.state == 'ok' else np.nan
            squares[i, c] = error**2
            over += int(error > 3.0 * one.sigma_position_m)
    rms = 1e3 * np.sqrt(np.nanmean(squares, axis=0))
    undetermined = (
        '' if scan.sensor_fit is None else ', '.join(sorted(scan.sensor_fit.undetermined))
    )
    ok = np.isfinite(squares).sum()
    return (
        float(np.sqrt(np.mean(rms**2))), float(rms.max()), 100.0 * over / max(ok, 1), undetermined,
    )  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rows', type=int, nargs='*', default=range(len(ROWS)))
    parser.add_argument('--seeds', type=int, nargs='*', default=SEEDS)
    parser.add_argument('--json', type=Path, help='file that gets the lines')
    given = parser.parse_args()
    print(HEAD, '|---' * HEAD.count(' | ') + '|---|', sep='\n', flush=True)
    harness.print_lines(
        (
            (f'row {index}, seed {seed}', row_of(*ROWS[index], seed))
            for index in given.rows
            for seed in given.seeds
        ),
        given.json,
    )


if __name__ == '__main__':
    main()
