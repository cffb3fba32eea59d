"""Poses that are wrong and ok while references fail together, in random cases of each seed.

From a random moment on 1 to 31 of the 32 references freeze, fall silent, are reversed, read a few
percent wrong, or read a share of another one, while metal comes near or passes. A pose in the
state ok is wrong beyond 1 mm and three standard deviations, the reference's jitter included.

    python test/bench/bench_failing_references.py [--seed 31] [--cases 100] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import harness
import numpy as np
from bench_references import judged
from bench_refit import JITTER_M

from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.tracked_session import track_session

BEFORE_S, AFTER_S = 4.0, 8.0
"""Time before the failure and after it that a case has, s."""
KINDS = ('frozen', 'silent', 'weaker', 'mixed', 'reversed')
GAIN, SHARE = 0.05, 0.03
"""Spread of the wrong gains, and share of another's reading."""


def failing(session: Session, rng: np.random.Generator) -> tuple[str, Session]:
    """Return a case in words and its stretch of the session."""
    reference = session.reference
    assert reference is not None
    count = reference.flux.shape[1]
    number, kind = int(rng.integers(1, count)), str(rng.choice(KINDS))
    moment = float(rng.uniform(reference.time[0] + 2.0, reference.time[-1] - BEFORE_S))
    chosen, others = rng.permutation(count)[:number], rng.permutation(count)[:number]
    flux = reference.flux.copy()
    first = int(np.searchsorted(reference.time, moment))
    late, source = flux[first:], reference.flux[first:]
    if kind == 'frozen':
        late[:, chosen] = reference.flux[first - 1, chosen]
    elif kind == 'silent':
        late[:, chosen] = 0.0
    elif kind == 'reversed':
        late[:, chosen] = -source[:, chosen]
    elif kind == 'weaker':
        late[:, chosen] *= 1 + GAIN * rng.normal(size=(number, 1))
    else:
        late[:, chosen] = (1 - SHARE) * source[:, chosen] + SHARE * source[:, others]
    begin, end = moment - BEFORE_S, moment + AFTER_S

    def cut(part: Any) -> Any:
        return part.frames(np.flatnonzero((part.time >= begin) & (part.time <= end)))

    tools = tuple(cut(tool) for tool in session.tools)
    case = replace(session, tools=tools, reference=cut(replace(reference, flux=flux)))
    return f'{number} {kind} from {moment:.1f} s', case


def counted(case: Session, model: Any, baseline: Session) -> tuple[int, int, int]:
    """Return how many poses are wrong and ok, are ok, and could be."""
    found = track_session(case, model, baseline=baseline, refit=True)
    series = [*found.sensors.values(), *found.bodies.values()]
    figures = judged(series, JITTER_M)
    return int(figures['gross']), int(figures['poses']), sum(len(s.estimates) for s in series)


def main() -> int:
    """Run the cases and print each and the sum; 1 when a pose was wrong and ok."""
    parser = argparse.ArgumentParser(description='poses while references fail together')
    parser.add_argument('--seed', type=int, default=31)
    parser.add_argument('--cases', type=int, default=100)
    parser.add_argument('--json', type=Path, help='file for the figures')
    args = parser.parse_args()
    scan, paths = harness.online_recordings()
    sessions = {
        name: load_session(path) for name, path in paths.items() if name.startswith('online')
    }
    if not sessions:
        print('needs the recordings online/approach and online/sweep')
        return 2
    baseline = load_session(scan)
    model = harness.calibrated(baseline, estimate=())
    rng, names = np.random.default_rng(args.seed), sorted(sessions)
    sums = np.zeros(3, dtype=int)
    for _ in range(args.cases):
        name = str(rng.choice(names))
        words, case = failing(sessions[name], rng)
        counts = counted(case, model, baseline)
        sums += counts
        print(f'{name}, {words}: {counts[0]} wrong of {counts[1]} ok of {counts[2]}', flush=True)
    figures = {
        'seed': args.seed, 'cases': args.cases, 'wrong': int(sums[0]), 'ok': int(sums[1]),
        'given_share': float(sums[1] / sums[2]),
    }  # fmt: skip
    print(json.dumps(figures))
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + '\n', encoding='utf-8')
    return int(sums[0] > 0)


if __name__ == '__main__':
    sys.exit(main())
