"""What the diagnosis calls effects that are put into recorded sessions: a confusion table.

Effects of channel, clock, pose and emitter kind are put exactly into the arrays of a clean session
and, in pairs, of sessions with metal, a plate or a drift (`injection.py`). Seeds are fixed; the
thresholds of the diagnosis were chosen on other seeds than these.

Run it by itself for single cases: ``python test/bench/bench_diagnosis.py pickup loose_contact``.
"""

from __future__ import annotations

import argparse
import sys
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import harness
import numpy as np
from injection import CATALOGUE, LISTED, SIZES, TOLERANCE, UNLISTED
from injection_subject import EMITTER, TRACK, Injection, Subject, Truth

from anser_ros.diagnosis.diagnose import Diagnosis, diagnose
from anser_ros.field.model import Dipoles, FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.sessions.baseline import baseline_flux
from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.starting_model import board_of

SHARED = harness.SESSIONS / 'effects'
REPORTED_SEEDS, EVERY = (203,), 10
"""Thresholds were chosen on seeds below 200, one rule on a case of 202. Every so many cases of the
reported ones are run, which takes some minutes; ``--seeds 203`` runs all 202."""
PAIRS = 24
CARRIERS = {
    's04': ('static_metal',),
    's05': ('moving_metal',),
    's07': ('coil_drift',),
    's12': ('conductive_plate', 'time_offset'),
}
"""Sessions that contain effects already, on top of which others are put."""
TO_BE_SEEN = 1.05
"""Residual over the floor from which an effect of no table has to show."""


@dataclass
class Outcome:
    """One run: what went in, what came out, and what to call that."""

    case: str
    size: str
    seed: int
    truth: Truth
    found: Diagnosis
    seconds: float
    verdict: str = ''
    pulls: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        """Names that were given."""
        return sorted(f.record.name for f in self.found.findings)

    def line(self) -> str:
        """In one line."""
        d = self.found
        pull = f' pull {np.sqrt(np.mean(np.square(self.pulls))):.1f}' if self.pulls else ''
        refused = [f'{t.label} {c.variation:.2f}/{c.share_of_rest:.2g}' for t, c in d.refused]
        labels = [f.term.label if f.term else f.record.name for f in d.findings]
        return (
            f'{self.verdict:<9} {self.case} {self.size} {self.seed}: {", ".join(labels) or "-"}; '
            f'{1e12 * d.flux_rms_before_t:.1f} -> {1e12 * d.flux_rms_after_t:.1f} pT '
            f'(floor {1e12 * d.flux_rms_floor_t:.1f}), unexplained {d.unexplained:.2f} '
            f'{",".join(d.depends_on[:3])}{pull}; {self.seconds:.0f} s '
            f'{" ".join(self.errors)}{" refused: " + "; ".join(refused) if refused else ""}'
        )


@cache
def factory() -> Session:
    """The calibration scan, which is the baseline too."""
    return load_session(SHARED / 'factory.mcap')


@cache
def model() -> FieldModel:
    """Calibrated on the scan, with the layout that the choice by held-out error ends with."""
    return harness.calibrated(factory())


@cache
def session(name: str) -> Session:
    """A recorded session."""
    return load_session(SHARED / f'{name}.mcap')


@cache
def recorded(name: str) -> Subject:
    """A session's arrays as they are."""
    given = session(name)
    reference, drawn = given.reference, nominal_model(board_of(given.setup))
    assert reference is not None
    clean = baseline_flux(factory(), reference.sensors)
    start = Subject(
        given.tools[0], reference, clean, model(), drawn, Dipoles.none(len(model().emitters))
    )
    start.illumination = start.problem().fields.illumination
    return start


def subject(name: str = 's01') -> Subject:
    """A session's arrays, to be changed."""
    return replace(recorded(name))


def run(
    case: str, injections: Sequence[Injection], size: str, seed: int, carrier: str = 's01'
) -> Outcome:
    """Put effects in, diagnose, and judge."""
    rng = np.random.default_rng([seed, zlib.crc32(f'{case} {size}'.encode())])
    target = subject(carrier)
    truth: Truth = {name: {} for name in CARRIERS.get(carrier, ())}
    for injection in sorted(injections, key=lambda i: i.stage):
        truth = {**truth, **injection.put(target, rng, SIZES[size])}
    began = time.process_time()
    found = diagnose(target.problem(), target.model)
    outcome = Outcome(case, size, seed, truth, found, time.process_time() - began)
    unknown = [i for i in injections if i.name in UNLISTED and i.name != 'reference_gain']
    allowed = {name for i in injections for name in i.allowed}
    outcome.verdict = judged(outcome, bool(unknown), allowed)
    return outcome


def judged(outcome: Outcome, unknown: bool, allowed: set[str]) -> str:
    """A word for an outcome; figures of parameters go into it."""
    found, wanted = set(outcome.names), set(outcome.truth)
    _compare(outcome)
    d = outcome.found
    if not unknown:
        if found - wanted and wanted - found:
            return 'CONFUSED'
        if found - wanted:
            return 'EXTRA'
        if wanted - found:
            small = d.flux_rms_before_t < TO_BE_SEEN * d.flux_rms_floor_t
            return 'too small' if small else 'MISSING'
        if len(outcome.names) != len(wanted):
            return 'TWICE'
        return 'OFF' if outcome.errors else 'exact'
    wrong = (found & set(CATALOGUE)) - wanted - allowed
    if wrong:
        return 'WRONG'
    if found - wanted:
        return 'new name' if (found - wanted) <= allowed else 'OTHER'
    if d.depends_on and d.flux_rms_after_t > 1.1 * d.flux_rms_floor_t:
        return 'said'
    if d.flux_rms_after_t < 1.1 * 60.4e-12:
        return 'unseen'
    return 'SILENT'


def _compare(outcome: Outcome) -> None:
    """Errors of the parameters against the limits asked for and against their sigmas."""
    for finding in outcome.found.findings:
        record = finding.record
        truth = outcome.truth.get(record.name, {})
        for key in ('channel', 'coil', 'channels', 'coils'):
            given = record.parameters.get(key)
            if key in truth and given is not None:
                same = list(np.atleast_1d(truth[key])) == list(np.atleast_1d(given))
                if not same:
                    outcome.errors.append(f'{record.name}.{key} {record.parameters[key]}')
        for key, wanted in truth.items():
            given, sigma = record.parameters.get(key), record.uncertainty.get(key)
            if given is None or sigma is None:
                continue
            error = np.asarray(given, dtype=float) - np.asarray(wanted, dtype=float)
            spread = np.asarray(sigma, dtype=float)
            if error.shape != spread.shape:
                continue
            use = spread > 0
            outcome.pulls += (error[use] / spread[use]).ravel().tolist()
            worst = float(np.max(np.abs(error)))
            limit = TOLERANCE.get(key, np.inf)
            if key == 'full_scale_t':
                worst /= float(wanted)
            if worst > limit and float(np.max(np.abs(error[use] / spread[use]))) > 3:
                outcome.errors.append(f'{record.name}.{key} off by {worst:.2g}')


def cases(seeds: Sequence[int]) -> Iterator[tuple[str, list[Injection], str, int, str]]:
    """Everything that is run."""
    every = {**LISTED, **UNLISTED}
    for seed in seeds:
        for name, injection in every.items():
            for size in SIZES:
                yield name, [injection], size, seed, 's01'
        rng = np.random.default_rng(seed)
        for number in range(PAIRS):
            pair = [str(n) for n in rng.choice(list(LISTED), 2, replace=False)]
            yield '+'.join(pair), [LISTED[n] for n in pair], 'medium', seed + number, 's01'
        late = [n for n, i in every.items() if i.stage == TRACK or i.stage >= EMITTER]
        for carrier, present in CARRIERS.items():
            for _ in range(4):
                # A second effect of the same name could not be told in a set of names.
                name = str(rng.choice([n for n in late if n not in present]))
                yield f'{carrier}+{name}', [every[name]], 'medium', seed, carrier


def rows() -> Iterator[harness.Row]:
    """Counts of each verdict, and how honest the sigmas are."""
    if not (SHARED / 's01.mcap').is_file():
        print(f'diagnosis: skipped, {SHARED}/s01.mcap is not there', file=sys.stderr)
        return
    groups: dict[str, list[Outcome]] = {'one': [], 'pair': [], 'carrier': [], 'unlisted': []}
    for case in list(cases(REPORTED_SEEDS))[::EVERY]:
        outcome = run(*case)
        print('  ' + outcome.line(), file=sys.stderr, flush=True)
        name = case[0]
        unknown = any(i.name in UNLISTED for i in case[1])
        kind = 'carrier' if case[4] != 's01' else 'pair' if '+' in name else 'one'
        groups['unlisted' if unknown else kind].append(outcome)
    for kind, outcomes in groups.items():
        if not outcomes:
            continue
        good = ('exact', 'too small') if kind != 'unlisted' else ('said', 'new name', 'unseen')
        count = sum(o.verdict in good or o.verdict == 'exact' for o in outcomes)
        yield harness.row(
            f'diagnosis/{kind}: right',
            count / len(outcomes),
            'share',
            target=0.95,
            target_is='least',
        )
    pulls = np.array([p for kind in ('one', 'pair') for o in groups[kind] for p in o.pulls])
    rms = float(np.sqrt(np.mean(np.clip(pulls, -10, 10) ** 2)))
    yield harness.row('diagnosis/pulls: rms', rms, '1', target=1.5)
    seconds = max(o.seconds for outcomes in groups.values() for o in outcomes)
    yield harness.row('diagnosis/slowest', seconds, 's', target=180.0)


def main() -> None:
    """Run chosen cases and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('names', nargs='*', help='cases (a+b for a pair); all when none is given')
    parser.add_argument('--seeds', nargs='*', type=int, default=[1])
    parser.add_argument('--sizes', nargs='*', default=list(SIZES), choices=list(SIZES))
    parser.add_argument('--carrier', default='s01')
    parser.add_argument('--part', default='0/1', help='k/n: every n-th case from the k-th on')
    args = parser.parse_args()
    every = {**LISTED, **UNLISTED}
    wanted = [
        (name, [every[n] for n in name.split('+')], size, seed, args.carrier)
        for seed in args.seeds
        for name in args.names
        for size in args.sizes
    ]
    start, step = (int(v) for v in args.part.split('/'))
    for case in list(wanted or cases(args.seeds))[start::step]:
        print(run(*case).line(), flush=True)


if __name__ == '__main__':
    main()
