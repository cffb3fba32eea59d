"""Writes boards with sessions whose effects are known to their truth files only.

    python test/bench/world/make.py --out DIR [--boards 3] [--sessions 12] [--seed 1] [--only b1]

Every board gets a folder: ``factory.mcap`` (the clean static scan), ``s01`` (clean) to ``sNN``
with effects, ``m01`` to ``m04`` with metal that comes close (up, sideways, beside, over),
``truth.json`` (each session's effects and their sizes), ``truth/NAME.npz`` (the true path).
What is there already is not made again. This world shares no physics with `anser_ros`.
"""
# ruff: noqa: E402  (threads are set before numpy comes in)

import argparse
import json
import os
import sys
import time
from pathlib import Path

for variable in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'NUMBA_NUM_THREADS'):
    os.environ.setdefault(variable, '1')
sys.path.insert(1, str(Path(__file__).resolve().parents[3]))  # to run from a bare checkout

import boards
import effects
import numpy as np
import scenarios
import unlisted
from laboratory import Laboratory
from recording import record_scan, record_session

CORE = (
    ('sensor_gain',),
    ('static_metal',),
    ('moving_metal',),
    ('conductive_plate',),
    ('coil_moved',),
)
"""What the first board has right after its clean session."""
LISTED = (
    'time_offset', 'channel_crosstalk', 'sensor_axis', 'coil_drift', 'registration', 'saturation',
    'lever_arm', 'phase_delay', 'pickup', 'coil_crosstalk', 'sensor_polarity', 'outliers',
    'excess_noise', 'cluster_axis', 'sensor_size', 'channel_noise',
)  # fmt: skip
UNLISTED = (
    'loose_contact', 'clock_rate', 'coil_step', 'swapped_channels', 'low_pass', 'gain_modulation',
    'registration_drift', 'optical_scale', 'iq_imbalance',
)  # fmt: skip
PAIRS = (
    ('lever_arm', 'coil_drift'), ('static_metal', 'sensor_gain'),
    ('conductive_plate', 'time_offset'), ('moving_metal', 'pickup'),
    ('coil_moved', 'sensor_axis'), ('registration', 'lever_arm'),
    ('channel_crosstalk', 'phase_delay'), ('static_metal', 'coil_drift'),
    ('saturation', 'time_offset'), ('two_metals',), ('moving_metal', 'time_offset'),
    ('static_metal', 'coil_moved'),
)  # fmt: skip
MOVING = ('approach', 'sweep', 'beside', 'over')
NAMES = dict.fromkeys(MOVING, 'moving_metal')
"""Where the truth file uses another name than the function here."""


def plan(index, count):
    """Effects of each session of a board after the clean one; every board goes on in the lists."""
    if index == 0:
        first, listed = list(CORE), 0
    else:
        first, listed = [CORE[(2 * index) % 5], CORE[(2 * index + 1) % 5]], 4 * index
    rest = count - 1 - len(first)
    shares = [max(1, rest // 2), max(1, rest // 4)]
    shares.append(max(0, rest - sum(shares)))
    lists = ([(name,) for name in LISTED], [(name,) for name in UNLISTED], PAIRS)
    starts = (listed, 3 * index, 2 * index)
    for names, start, share in zip(lists, starts, shares, strict=True):
        first += [names[(start + i) % len(names)] for i in range(share)]
    return first[: count - 1]


def function_of(name):
    """The function that makes an effect of a name."""
    for module in (effects, unlisted, scenarios):
        if hasattr(module, name):
            return getattr(module, name)
    raise KeyError(name)


def make_session(folder, board, name, kinds, seed):
    """Record one session and add its truth; returns the truth."""
    rng = np.random.default_rng(seed)
    lab = Laboratory.clean(board)
    truth = {NAMES.get(kind, kind): function_of(kind)(lab, rng) for kind in kinds}
    path = record_session(folder / f'{name}.mcap', lab, rng)
    np.savez_compressed(folder / 'truth' / f'{name}.npz', **path)
    return truth


def make_board(folder, index, count, seed, number):
    """Build a board and record what is not there yet."""
    board = boards.build(index, np.random.default_rng([seed, number]))
    (folder / 'truth').mkdir(parents=True, exist_ok=True)
    ledger = folder / 'truth.json'
    truth = json.loads(ledger.read_text()) if ledger.exists() else {}
    if not (folder / 'factory.mcap').exists():
        scan = record_scan(
            folder / 'factory.mcap',
            Laboratory.clean(board),
            np.random.default_rng([seed, number, 1]),
        )
        np.savez_compressed(folder / 'truth' / 'factory.npz', **scan)
    sessions = {'s01': ()}
    sessions |= {f's{i + 2:02d}': kinds for i, kinds in enumerate(plan(index, count))}
    sessions |= {f'm{i + 1:02d}': (kind,) for i, kind in enumerate(MOVING)}
    for name, kinds in sessions.items():
        if name in truth:
            continue
        begun = time.monotonic()
        (folder / f'{name}.mcap').unlink(missing_ok=True)
        truth[name] = make_session(folder, board, name, kinds, [seed, number, 2, *name.encode()])
        ledger.write_text(json.dumps(truth, indent=1) + '\n')
        print(f'{folder.name}/{name}  {time.monotonic() - begun:5.1f} s', flush=True)


def main():
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', required=True, type=Path)
    parser.add_argument('--boards', type=int, default=3)
    parser.add_argument('--sessions', type=int, default=12, help='sNN of each board')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--only', help='the one board to make, such as b1')
    args = parser.parse_args()
    for index in range(args.boards):
        name = f'b{index + 1}'
        if args.only in (None, name):
            make_board(args.out / name, index, args.sessions, args.seed, index)


if __name__ == '__main__':
    main()
