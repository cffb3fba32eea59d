"""Puts faults on the real nodes, one after the other, and says what came of each.

Every fault is put on a running chain (simulated control unit, a line that can be damaged,
acquisition, field_model, tracker), watched for a while, and taken off again. The truth is exact:
the simulated unit publishes the pose that it works its samples out from. A pose that was published
and is wrong by more than max(3 sigma, 1 mm) is the worst that can happen; then come a node that
ends, and poses that are not back a second after the fault has gone.
"""

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from fault import Command, Fault, nothing
from faults_files import COMMANDS
from faults_graph import GRAPH
from faults_line import CLOCK, REFERENCES, SERIAL, TOGETHER
from faults_models import MODELS
from faults_processes import PROCESSES
from recorded import RECORDED, Drift
from rig import RATE_HZ, Rig, domain_pool
from table import ALLOWED_S, Row, line, load, save, write_docs
from witness import WINDOW_S, is_wrong

DOCUMENT = Path(__file__).resolve().parents[2] / 'docs' / 'faults.md'

CONTROL = (
    Fault('nothing', 'nothing', lambda rig, rng: nothing, 5.0),
    Fault('nothing-metal', 'nothing, metal moves', lambda rig, rng: nothing, 9.0, 'metal'),
)
GROUPS: dict[str, tuple[Fault, ...]] = {
    'control': CONTROL, 'serial': SERIAL, 'clock': CLOCK, 'references': REFERENCES,
    'together': TOGETHER, 'models': MODELS, 'graph': GRAPH, 'processes': PROCESSES,
}  # fmt: skip
RECOVERY_S = 12.0
"""Longest wait for poses after a fault has gone, s; then the chain is started anew."""
AFTER_S = 1.0
"""Time after poses are back in which wrong ones still count for the fault, s."""
UNIT_LATE_S = 0.003
"""Lateness of the simulated unit itself, s, on a busy machine, from which on it says nothing how
many poses there are, and how soon they are back; a wrong one counts at any time."""
AT_ONCE = (2, 3)
"""Least and most faults of a random combination."""


@dataclass
class Chain:
    """The running chain of the present world, started anew when it is asked for another."""

    folder: Path
    domain: int
    rig: Rig | None = None

    def of(self, world: str) -> Rig:
        """Return a whole chain in a world."""
        if self.rig is not None and (self.rig.world != world or not self._is_sound()):
            self.end()
        if self.rig is None:
            self.rig = Rig(self.folder, self.domain, world)
        return self.rig

    def _is_sound(self) -> bool:
        assert self.rig is not None
        try:
            self.rig.wait_until(self.rig.is_whole, RECOVERY_S, 'poses')
        except RuntimeError:
            return False
        return not self.rig.crashed()

    def end(self) -> None:
        """End the chain."""
        if self.rig is not None:
            self.rig.close()
            self.rig = None


def tried(chain: Chain, faults: Sequence[Fault], seed: int, lasts_s: float | None) -> Row:
    """Put faults on together, watch, take them off, and return what came of it."""
    worlds = {fault.world for fault in faults}
    rig = chain.of('metal' if 'metal' in worlds else 'clean')
    rng = np.random.default_rng(seed)
    witness = rig.witness
    before = {state.name: state.words for state in witness.states}
    time.sleep(WINDOW_S)
    begin = time.monotonic()
    offs = [fault.on(rig, rng) for fault in faults]
    time.sleep(lasts_s or max(fault.lasts_s for fault in faults))
    for off in reversed(offs):
        off()
    gone = time.monotonic()
    while not rig.is_whole() and time.monotonic() < gone + RECOVERY_S:
        time.sleep(0.02)
    whole = rig.is_whole()
    # What the last window began with is when poses were back.
    back = max(0.0, time.monotonic() - gone - WINDOW_S) if whole else None
    time.sleep(AFTER_S)
    seen = witness.errors(begin, time.monotonic() - 0.1)
    judged = [one for one in seen if not rig.line.late(one[0].arrival_s, UNIT_LATE_S)]
    bad = [(pose, error) for pose, error in seen if is_wrong(pose, error)]
    told = [
        s for s in witness.states
        if s.arrival_s > begin and s.level > 0 and before.get(s.name) != s.words
    ]  # fmt: skip
    heard = tuple(dict.fromkeys(f'{s.name.removeprefix("anser/")}: {s.words}' for s in told))
    crashed = tuple(rig.crashed())
    if any(fault.spoils for fault in faults):
        chain.end()
    worst, error = max(bad, key=lambda one: one[1], default=(None, None))
    group = next((g for g, all_ in GROUPS.items() if faults[0] in all_), 'several')
    return Row(
        group, _name(faults), ' and '.join(fault.what for fault in faults),
        said=heard[0] if heard else '',
        detected_s=told[0].arrival_s - begin if told else None,
        poses=len(judged), wrong=len(bad), worst_m=error,
        sigma_m=None if worst is None else worst.sigma_m,
        back_s=back, crashed=crashed, skipped=len(seen) - len(judged), heard=heard,
    )  # fmt: skip


def commanded(command: Command) -> Row:
    """Give a command its input, and return how it took it."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = command.arguments(Path(folder))
        begin = time.monotonic()
        code, said = Rig.run(*arguments)
        took = time.monotonic() - begin
    good = code == 2 and command.says in said
    crashed = () if good else (f'exit {code}: {said}',)
    return Row('files', command.name, command.what, said, took, 0, 0, None, None, 0.0, crashed)


def minimised(chain: Chain, faults: Sequence[Fault], seed: int, lasts_s: float | None) -> str:
    """Return the shortest command line that still fails as a combination of faults did."""
    for count in range(1, len(faults)):
        for some in itertools.combinations(faults, count):
            row = tried(chain, some, seed, lasts_s)
            print('    ' + line(row), flush=True)
            if row.failed(ALLOWED_S):
                return _command(some, seed, lasts_s)
    return _command(faults, seed, lasts_s)


def _command(faults: Sequence[Fault], seed: int, lasts_s: float | None) -> str:
    names = _name(faults)
    duration = '' if lasts_s is None else f' --duration {lasts_s:g}'
    return f"make chaos ARGS='--only {names} --seed {seed}{duration}'"


def chosen(args: argparse.Namespace) -> tuple[list[list[Fault]], list[Command | Drift]]:
    """Return the faults to be tried live, each alone or together, and all others."""
    known = {fault.name: fault for group in GROUPS.values() for fault in group}
    groups: dict[str, tuple[Command | Drift, ...]] = {'files': COMMANDS, 'recorded': RECORDED}
    groups |= {one.name: (one,) for one in (*COMMANDS, *RECORDED)}
    trials: list[list[Fault]] = []
    asked: list[Command | Drift] = []
    for names in args.only or (*GROUPS, 'files', 'recorded'):
        if names in GROUPS:
            trials += [[fault] for fault in GROUPS[names]]
        elif names in groups:
            asked += groups[names]
        else:
            missing = [name for name in names.split('+') if name not in known]
            if missing:
                raise SystemExit(f'chaos: no fault {missing[0]}; --list names them')
            trials.append([known[name] for name in names.split('+')])
    return trials, asked


def combinations(seed: int, count: int) -> list[list[Fault]]:
    """Return random combinations of faults that may come together."""
    rng = np.random.default_rng(seed)
    pool = [f for group in GROUPS.values() for f in group if f.combines]
    return [
        [pool[i] for i in rng.choice(len(pool), int(rng.integers(AT_ONCE[0], AT_ONCE[1] + 1)),
                                     replace=False)]
        for _ in range(count)
    ]  # fmt: skip


def main() -> int:
    """Run the trial; 1 when something failed, or could not be judged on a busy machine."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n')[0])
    parser.add_argument(
        '--only', nargs='+', metavar='NAME', help='groups, faults, or A+B together'
    )
    parser.add_argument('--seed', type=int, default=1, help='of what is random in a fault')
    parser.add_argument('--duration', type=float, help='how long each fault lasts, s')
    parser.add_argument('--random', type=int, default=0, metavar='N', help='so many combinations')
    parser.add_argument('--write-docs', action='store_true', help='write docs/faults.md anew')
    parser.add_argument('--out', type=Path, default=Path('chaos.json'), help='file with all rows')
    parser.add_argument(
        '--again', type=Path, metavar='FILE',
        help='repeat what the run of a chaos.json could not judge, and keep the rest of its rows',
    )  # fmt: skip
    parser.add_argument(
        '--keep', action='store_true', help='keep the rows that --out has of other faults'
    )
    parser.add_argument('--list', action='store_true', help='name all faults and end')
    args = parser.parse_args()
    trials, others = chosen(args)
    if args.list:
        for one in (*itertools.chain.from_iterable(trials), *others):
            print(f'{one.name:24} {one.what}')
        return 0
    if args.random:
        trials, others = combinations(args.seed, args.random), []
    # Faults of one world share a chain.
    trials.sort(key=lambda faults: max(fault.world == 'metal' for fault in faults))
    found: dict[str, Row] = {}
    if args.again or (args.keep and args.out.is_file()):
        found = {row.name: row for row in load(args.again or args.out)}
    if args.again:
        open_ = {row.name for row in found.values() if not row.is_judged}
        trials = [faults for faults in trials if _name(faults) in open_]
        others = []
    with tempfile.TemporaryDirectory(prefix='anser_chaos_') as folder, domain_pool() as domains:
        chain = Chain(Path(folder), domains.take())
        try:
            for one in others:
                rows = one.rows(args.seed) if isinstance(one, Drift) else [commanded(one)]
                for row in rows:
                    _note(row, found, args.out)
            for faults in trials:
                row = _tried_surely(chain, faults, args)
                _note(row, found, args.out)
                if len(faults) > 1 and args.random and row.failed(ALLOWED_S):
                    print('  ' + minimised(chain, faults, args.seed, args.duration), flush=True)
        finally:
            chain.end()
    order = ('files', *GROUPS, 'several', 'recorded')
    rows = sorted(found.values(), key=lambda row: order.index(row.group))
    save(args.out, rows)
    failed = [row for row in rows if row.failed(ALLOWED_S)]
    poses, wrong = sum(row.poses for row in rows), sum(row.wrong for row in rows)
    print(f'{len(rows)} faults, {len(failed)} failed; {wrong} of {poses} poses wrong and ok')
    busy = [row.name for row in rows if not row.is_judged]
    if skipped := sum(row.skipped for row in rows):
        print(f'{skipped} poses not judged: the machine was too busy for the simulated unit')
    if busy:
        print(f'{len(busy)} faults say nothing for that reason: {" ".join(busy)}')
    if args.write_docs:
        write_docs(DOCUMENT, rows, args.seed, RATE_HZ)
    return 1 if failed or busy else 0


def _name(faults: Sequence[Fault]) -> str:
    return '+'.join(fault.name for fault in faults)


def _note(row: Row, found: dict[str, Row], out: Path) -> None:
    """Keep a row, and all of them in the file: a trial that is ended has its rows."""
    found[row.name] = row
    save(out, found.values())
    print(line(row), flush=True)


def _tried_surely(chain: Chain, faults: Sequence[Fault], args: argparse.Namespace) -> Row:
    """Try faults; a chain that does not come up is a failure of the fault, not of the trial."""
    try:
        return tried(chain, faults, args.seed, args.duration)
    except (RuntimeError, OSError) as error:
        chain.end()
        names = _name(faults)
        return Row('several', names, names, '', None, 0, 0, None, None, None, (str(error),))


if __name__ == '__main__':
    sys.exit(main())
