"""Record the small simulated sessions of the folder bags/ again."""

import argparse
from pathlib import Path

import numpy as np

from anser_ros.settings import Accuracy
from anser_ros.simulation.recording import STATIC_NOISE_T, GridScan, record
from anser_ros.simulation.world import (
    Approach,
    Lissajous,
    World,
    board_source,
    manufactured,
    steel_disc,
)
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config

SEED = 1
"""Of board and noise: the same one gives the same fluxes."""
RATE_HZ = 25.0
"""Rate of the fluxes of moving tools, Hz: half of the demo's, which keeps the bags small."""
OPTICAL_RATE_HZ = 60.0
"""Rate of the optical poses of moving tools, Hz, as usual for optical trackers; it is no multiple
of `RATE_HZ`, so that poses have to be interpolated."""
SECONDS = 8.0
"""Duration of the recordings of moving tools, s: enough for metal to approach and leave."""
SCAN_HEIGHTS_M = (0.12, 0.18)
"""Heights of the scan's two layers, m. With them the three clusters of the tool cover 0.09 to 0.21
m, the heights that the demo's tool reaches."""
SCAN_ERRORS = Accuracy(STATIC_NOISE_T, 0.01e-3, 0.05e-3)
"""Errors of the scan: means over a second at rest, of 60 optical poses with a jitter of 0.07 mm
and 0.4 mrad each."""


def main(argv=None):
    """Write factory, moving, metal and scan.mcap; bags of those names are replaced."""
    parser = argparse.ArgumentParser(description=__doc__)
    words = 'folder for the bags, made if missing (%(default)s)'
    parser.add_argument('--out', type=Path, default=Path('bags'), metavar='DIR', help=words)
    args = parser.parse_args(argv)
    setup = parse_setup(read_config('demo_setup.yaml'))
    rng = np.random.default_rng(SEED)
    source = board_source(manufactured(setup, rng))
    args.out.mkdir(parents=True, exist_ok=True)
    scan, tall = GridScan(), GridScan(heights_m=SCAN_HEIGHTS_M)
    frames = int(SECONDS * RATE_HZ)
    # The path stays within the heights that the scan covers, outside which a model is worse.
    path = Lissajous(centre_m=(0.0, 0.0, 0.16), amplitude_m=(0.08, 0.08, 0.02))
    scanned, scanned_tall, moving = (
        World(setup, source, paths=dict.fromkeys(setup.bodies, way)) for way in (scan, tall, path)
    )
    visit = steel_disc(Approach(near_m=(0.05, -0.03, -0.06), start_s=2.0, travel_s=3.0))
    metal = World(setup, source, paths=dict.fromkeys(setup.bodies, path), metal=[visit])
    static, live = Accuracy(STATIC_NOISE_T), Accuracy()
    sessions = (
        ('factory', scanned, scan.frames, 1.0, None, static),
        ('moving', moving, frames, RATE_HZ, OPTICAL_RATE_HZ, live),
        ('metal', metal, frames, RATE_HZ, OPTICAL_RATE_HZ, live),
        ('scan', scanned_tall, tall.frames, 1.0, None, SCAN_ERRORS),
    )
    for name, world, count, rate, optical_rate, errors in sessions:
        file = args.out / f'{name}.mcap'
        file.unlink(missing_ok=True)
        record(
            str(file), world, frames=count, rate_hz=rate, optical_rate_hz=optical_rate,
            errors=errors, rng=rng,
        )  # fmt: skip
        print(f'{file}: {count} frames, {file.stat().st_size / 1e6:.2f} MB, simulated')


if __name__ == '__main__':
    main()
