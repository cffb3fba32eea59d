"""Makes labs in which everything is a little wrong, calibrates and diagnoses in them, and scores.

    python test/bench/world/dirty.py --out DIR [--rows 0 1 2] [--seed 703] [--json FILE]

Every row has a board, a tool whose coils are all a little wrong in gain, axis and place, a lever
arm, and a camera that stamps off. One scan by hand is calibrated; sessions with nothing new, a
gain, metal at rest, a drift and another registration are diagnosed. A line is printed for each.
Errors of positions are exact, of every coil of the tool in the clean session.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

import harness
import numpy as np
import recording
from boards import build
from effects import coil_drift, registration, sensor_gain
from laboratory import Laboratory
from scenarios import static_metal
from scoring import true_errors

ROWS = (
    (0, 9, 0.004, 0.018), (1, 5, 0.02, 0.04), (3, 2, 0.001, 0.0), (2, 6, 0.01, -0.025),
    (4, 1, 0.004, 0.01),
)  # fmt: skip
"""Board, most coils of the tool, spread of gains, and how late the camera's stamps are, s."""
SESSIONS = {
    'check': (), 'gain': (sensor_gain,), 'metal': (static_metal,),
    'drift': (coil_drift, registration),
}  # fmt: skip


def wrong(board, gains, late_s, rng):
    """The room with a tool and a camera that are as no setup says."""
    lab, tool = Laboratory.clean(board), board.tool
    count = len(tool.channel)
    place = tool.place + 0.12e-3 * rng.normal(size=(count, 3)) + 0.35e-3 * rng.normal(size=3)
    axis = tool.axis + 8e-3 * rng.normal(size=(count, 3))
    lab.tool = replace(tool, place=place, axis=axis / np.linalg.norm(axis, axis=1)[:, None])
    factor = (1 + gains * rng.normal(size=count)) * np.exp(5e-3j * rng.normal(size=count))

    def gain(lab, time, channels, flux):
        own = np.isin(channels, tool.channel).all()
        return flux * factor[:, None] if own else flux

    lab.on_flux.append(gain)
    lab.on_optical.append(lambda t, p, r: (t - late_s, p, r))
    return lab


def make(folder, row, seed):
    """Record the scan and the sessions of a row that are not there yet; return its board."""
    index, coils, gains, late_s = ROWS[row]
    board = build(index, np.random.default_rng([seed, row]))
    few = board.tool
    keep = {k: getattr(few, k)[:coils] for k in ('channel', 'name', 'place', 'axis', 'length')}
    board = replace(board, tool=replace(few, **keep))
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, kinds) in enumerate({'scan': (), **SESSIONS}.items()):
        lab = wrong(board, gains, late_s, np.random.default_rng([seed, row, 1]))
        rng = np.random.default_rng([seed, row, 2, number])
        for kind in kinds:
            kind(lab, rng)
        if not (folder / f'{name}.npz').exists():
            path = recording.record_session(folder / f'{name}.mcap', lab, rng)
            np.savez_compressed(folder / f'{name}.npz', **path)
    return board


def lines(out, row, seed):
    """Run the commands on a row; yield its lines of the table."""
    folder = out / f'{seed}_{row}'
    board = make(folder, row, seed)
    runs, model = folder / 'runs', folder / 'model.yaml'
    made = harness.anser('calibrate', folder / 'scan.mcap', '--out', model, '--force')
    tracked = '--model', model, '--out', runs / 'evaluate'
    harness.anser('evaluate', folder / 'check.mcap', *tracked)
    _, _, gains, late_s = ROWS[row]
    rmse_m, over = true_errors(runs / 'evaluate' / 'poses.csv', folder / 'check.npz')
    yield (
        f'| {board.design.name} | {len(board.tool.channel)} | {100 * gains:g} | {1e3 * late_s:g} '
        f'| {1e3 * rmse_m:.3f} mm | {100 * over:.2f} | {made.cpu_s:.0f} s |'
    )
    for name, kinds in SESSIONS.items():
        bag = folder / f'{name}.mcap'
        harness.anser('diagnose', bag, '--model', model, '--out', runs / name)
        found = json.loads((runs / name / 'diagnosis.json').read_text())
        after = 1e12 * found['held_out']['flux_rms_after_t']
        names = ', '.join(effect['name'] for effect in found['effects']) or 'nothing'
        put = ', '.join(kind.__name__ for kind in kinds) or 'nothing'
        yield f'| {board.design.name} | {name}: {put} | {names} | {after:.1f} pT |'


def main():
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', required=True, type=Path)
    parser.add_argument('--rows', type=int, nargs='*', default=range(len(ROWS)))
    parser.add_argument('--seed', type=int, default=703)
    parser.add_argument('--json', type=Path, help='file that gets the lines')
    args = parser.parse_args()
    harness.print_lines(
        (
            (f'row {row}, seed {args.seed}: {name}', line)
            for row in args.rows
            for name, line in zip(
                ('scan', *SESSIONS), lines(args.out, row, args.seed), strict=True
            )
        ),
        args.json,
    )


if __name__ == '__main__':
    main()
