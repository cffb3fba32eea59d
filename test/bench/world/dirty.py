"""Makes labs in which everything is a little wrong, calibrates and diagnoses in them, and scores.

    python test/bench/world/dirty.py --out DIR [--rows 0 1 2] [--seed 703] [--json FILE]

Every row has a board, a tool whose coils are all a little wrong in gain, axis and place, a lever
arm, and a camera that stamps off. One scan by hand is calibrated; sessions with nothing new, a
gain, metal at rest, a drift and another registration are diagnosed. A line is printed for each.
Errors of positions are exact, of every coil of the tool in the clean session.
"""
# ruff: noqa: E402  (threads are set before numpy comes in)

import argparse
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

for variable in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'NUMBA_NUM_THREADS'):
    os.environ.setdefault(variable, '1')
sys.path.insert(1, str(Path(__file__).resolve().parents[3]))  # to run from a bare checkout

import boards
import effects
import numpy as np
import recording
import scenarios
from judge import run
from laboratory import Laboratory
from scoring import true_errors

ROWS = (
    (0, 9, 0.004, 0.018), (1, 5, 0.02, 0.04), (3, 2, 0.001, 0.0), (2, 6, 0.01, -0.025),
    (4, 1, 0.004, 0.01),
)  # fmt: skip
"""Board, most coils of the tool, spread of gains, and how late the camera's stamps are, s."""
SESSIONS = {
    'check': (), 'gain': (effects.sensor_gain,), 'metal': (scenarios.static_metal,),
    'drift': (effects.coil_drift, effects.registration),
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
    """Record the scan and the sessions of a row that are not there yet; return what is in them."""
    index, coils, gains, late_s = ROWS[row]
    board = boards.build(index, np.random.default_rng([seed, row]))
    few = board.tool
    keep = {k: getattr(few, k)[:coils] for k in ('channel', 'name', 'place', 'axis', 'length')}
    board, truth = replace(board, tool=replace(few, **keep)), {}
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, kinds) in enumerate({'scan': (), **SESSIONS}.items()):
        lab = wrong(board, gains, late_s, np.random.default_rng([seed, row, 1]))
        rng = np.random.default_rng([seed, row, 2, number])
        truth[name] = {kind.__name__: kind(lab, rng) for kind in kinds}
        if not (folder / f'{name}.npz').exists():
            path = recording.record_session(folder / f'{name}.mcap', lab, rng)
            np.savez_compressed(folder / f'{name}.npz', **path)
    return board, truth


def lines(out, row, seed):
    """Run the commands on a row; yield its lines of the table."""
    folder = out / f'{seed}_{row}'
    board, truth = make(folder, row, seed)
    runs, model = folder / 'runs', str(folder / 'model.yaml')
    scan, check = str(folder / 'scan.mcap'), str(folder / 'check.mcap')
    made = run(runs / 'calibrate', ['calibrate', scan, '--out', model], False)
    if made['failed']:
        raise SystemExit(f'{folder.name}: calibrate: {made["failed"]}')
    tracked = runs / 'evaluate'
    run(tracked, ['evaluate', check, '--model', model, '--out', str(tracked)], False)
    _, _, gains, late_s = ROWS[row]
    exact = true_errors(tracked / 'poses.csv', folder / 'check.npz')
    yield (
        f'| {board.design.name} | {len(board.tool.channel)} | {100 * gains:g} | {1e3 * late_s:g} '
        f'| {1e3 * exact["rmse_m"]:.3f} mm | {100 * exact["over_3_sigma"]:.2f} '
        f'| {made["seconds"]:.0f} s |'
    )
    for name in SESSIONS:
        there = runs / name
        arguments = ['diagnose', str(folder / f'{name}.mcap'), '--model', model]
        run(there, [*arguments, '--out', str(there)], False)
        found = json.loads((there / 'diagnosis.json').read_text())
        after = 1e12 * found['held_out']['flux_rms_after_t']
        names = ', '.join(effect['name'] for effect in found['effects']) or 'nothing'
        put = ', '.join(truth[name]) or 'nothing'
        yield f'| {board.design.name} | {name}: {put} | {names} | {after:.1f} pT |'


def main():
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', required=True, type=Path)
    parser.add_argument('--rows', type=int, nargs='*', default=range(len(ROWS)))
    parser.add_argument('--seed', type=int, default=703)
    parser.add_argument('--json', type=Path, help='file that gets the lines')
    args = parser.parse_args()
    kept = []
    for row in args.rows:
        for number, line in enumerate(lines(args.out, row, args.seed)):
            print(line, flush=True)
            name = ('scan', *SESSIONS)[number]
            kept.append({'name': f'row {row}, seed {args.seed}: {name}', 'line': line})
            if args.json:
                args.json.write_text(json.dumps(kept, indent=1) + '\n')


if __name__ == '__main__':
    main()
