"""Runs calibrate, diagnose and evaluate over boards with a truth, and prints how they did.

    python test/bench/world/judge.py DIR [--only 'b1/s0*'] [--fresh] [--no-diagnose] [--repo R]

DIR holds what `make.py` writes. Only the commands are used, one at a time. What they write goes to
``DIR/runs``, and is not run again unless ``--fresh`` is given; the table goes to ``results.md``.
Errors of positions are against the exact path; the jitter of the optical tracker is in none.
"""

import argparse
import fnmatch
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

from scoring import describe, judge_names, true_errors

REPO = Path(__file__).resolve().parents[3]
LIMIT_S = 1800


def run(folder, arguments, fresh, repo=REPO):
    """Run a command once; the seconds of processor time that it took, or why it failed."""
    note = folder / 'run.json'
    if note.exists() and not fresh:
        return json.loads(note.read_text())
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    settings = {f'{name}_NUM_THREADS': '1' for name in ('OPENBLAS', 'OMP', 'NUMBA')}
    settings['PYTHONPATH'] = str(repo)
    begun, used = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        done = subprocess.run(
            [sys.executable, '-P', '-m', 'anser_ros.cli.main', *arguments],
            env={**os.environ, **settings},
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
        error = done.stderr.strip().splitlines()[-1:] if done.returncode else []
        result = {'failed': f'exit {done.returncode}: {"".join(error)}' if done.returncode else ''}
    except subprocess.TimeoutExpired:
        result = {'failed': f'took more than {LIMIT_S} s'}
    result['wall_s'] = time.monotonic() - begun
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    result['seconds'] = spent.ru_utime + spent.ru_stime - used.ru_utime - used.ru_stime
    head = subprocess.run(
        ['git', 'log', '-1', '--format=%h'], cwd=repo, capture_output=True, text=True
    )
    result['commit'] = head.stdout.strip()
    note.write_text(json.dumps(result) + '\n')
    return result


class Judge:
    """One folder of boards."""

    def __init__(self, folder, fresh, repo):
        self.folder, self.fresh, self.repo = folder, fresh, repo
        self.runs = folder / 'runs'

    def model(self, board):
        """Calibrate once; the model's path."""
        out = self.runs / board / 'calibration'
        model = out / 'model.yaml'
        scan = self.folder / board / 'factory.mcap'
        arguments = ['calibrate', str(scan), '--out', str(model), '--report', str(out / 'report')]
        done = run(out, arguments, False, self.repo)
        if done['failed']:
            raise SystemExit(f'{board}: calibrate: {done["failed"]}')
        return model

    def tracked(self, board, name, label, model, *more):
        """Errors of `evaluate` against the exact path."""
        out = self.runs / board / name / label
        bag = self.folder / board / f'{name}.mcap'
        arguments = ['evaluate', str(bag), '--model', str(model), '--out', str(out), *more]
        done = run(out, arguments, self.fresh, self.repo)
        if done['failed']:
            return {'failed': done['failed']}
        path = self.folder / board / 'truth' / f'{name}.npz'
        return {**true_errors(out / 'poses.csv', path), 'seconds': done['seconds'], 'failed': ''}

    def session(self, board, name, truth, diagnose):
        """Everything about one session, and keep it in runs/BOARD/NAME/summary.json."""
        model = self.model(board)
        scan = ['--baseline', str(self.folder / board / 'factory.mcap')]
        summary = {'truth': truth}
        summary['frozen'] = self.tracked(board, name, 'frozen', model, '--gate', 'inf')
        summary['refit'] = self.tracked(board, name, 'refit', model, '--refit', *scan)
        if diagnose:
            out = self.runs / board / name / 'diagnosis'
            bag = str(self.folder / board / f'{name}.mcap')
            arguments = ['diagnose', bag, '--model', str(model), '--out', str(out), *scan]
            done = run(out, arguments, self.fresh, self.repo)
            summary['diagnosis'] = done
            if not done['failed']:
                summary['document'] = json.loads((out / 'diagnosis.json').read_text())
                found = out / 'model.yaml'
                effects = {effect['name'] for effect in summary['document']['effects']}
                live = ['--refit', *scan] if 'moving_metal' in effects else []
                summary['after'] = self.tracked(board, name, 'after', found, *live)
        target = self.runs / board / name / 'summary.json'
        target.write_text(json.dumps(summary, indent=1) + '\n')
        return summary


def millimetres(result, key='rmse_m'):
    """A cell."""
    if result is None:
        return '-'
    if result['failed']:
        return 'failed'
    value = result[key]
    return '-' if value is None else f'{1e3 * value:.3f}'


def _ratio(value, clean):
    return '-' if not value or not clean else f'{value / clean:.2f}'


def diagnosis_row(name, summary, clean):
    """A line of the diagnosis table."""
    truth = summary['truth']
    said = ' + '.join(truth) or 'clean'
    done = summary['diagnosis']
    if done['failed']:
        return [name, said, done['failed'], *[''] * 7, f'{done["seconds"]:.0f}']
    document = summary['document']
    held, found = document['held_out'], document['effects']
    clean_held = clean['document']['held_out'] if clean and 'document' in clean else {}
    rest = document['unexplained']
    return [
        name,
        said,
        judge_names(truth, found, rest),
        describe(truth, found),
        f'{1e12 * held["flux_rms_before_t"]:.0f} -> {1e12 * held["flux_rms_after_t"]:.0f}',
        _ratio(held['flux_rms_after_t'], held['flux_rms_floor_t']),
        _ratio(held['flux_rms_after_t'], clean_held.get('flux_rms_after_t')),
        f'{millimetres(summary["frozen"])} -> {millimetres(summary["after"])}',
        _ratio(held['position_rmse_after_m'], clean_held.get('position_rmse_after_m')),
        f'{rest["fraction"]:.2f} {" ".join(rest["depends_on"])}'.strip(),
        f'{done["seconds"]:.0f}',
    ]


def refit_row(name, summary):
    """A line of the refit table."""
    refit = summary['refit']
    if refit['failed']:
        return [name, ' + '.join(summary['truth']), refit['failed'], *[''] * 5]
    scenario = next((t['scenario'] for t in summary['truth'].values() if 'scenario' in t), '')
    return [
        name,
        f'{" + ".join(summary["truth"]) or "clean"} {scenario}'.strip(),
        millimetres(summary['frozen']),
        millimetres(refit),
        millimetres(refit, 'last_m'),
        f'{100 * refit["tracked"]:.1f} %',
        f'{100 * refit["over_3_sigma"]:.2f} %',
        f'{refit["seconds"]:.0f}',
    ]


def table(head, rows):
    """Markdown."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join('| ' + ' | '.join(str(c) for c in line) + ' |' for line in lines)


def report(folder):
    """Both tables from all summaries that are there."""
    paths = sorted((folder / 'runs').glob('*/*/summary.json'))
    every = {f'{p.parts[-3]}/{p.parts[-2]}': json.loads(p.read_text()) for p in paths}
    diagnosed = [
        diagnosis_row(name, summary, every.get(f'{name.split("/")[0]}/s01'))
        for name, summary in every.items()
        if 'diagnosis' in summary
    ]
    refitted = [refit_row(name, summary) for name, summary in every.items()]
    right = sum(row[2] == 'right' for row in diagnosed)
    commits = {s['diagnosis']['commit'] for s in every.values() if 'diagnosis' in s}
    return '\n\n'.join(
        [
            f'Commits: {", ".join(sorted(commits))}. Names right: {right} of {len(diagnosed)}.',
            table(
                ['session', 'truth', 'names', 'parameter error ((!) over tolerance)',
                 'flux rms pT', '/ floor', '/ clean', 'position mm (exact), frozen -> after',
                 'position / clean (held out)', 'unexplained', 'CPU s'],
                diagnosed,
            ),
            table(
                ['session', 'truth', 'frozen mm', 'refit mm', 'refit last 8 s', 'tracked',
                 'over 3 sigma', 'CPU s'],
                refitted,
            ),
        ]
    )  # fmt: skip


def main():
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--only', default='*', help="such as 'b1/s0*'")
    parser.add_argument('--fresh', action='store_true', help='run again what was run')
    parser.add_argument('--no-diagnose', action='store_true', help='calibrate and evaluate only')
    parser.add_argument('--repo', type=Path, default=REPO, help='whose anser_ros is judged')
    args = parser.parse_args()
    folder = args.folder.resolve()
    judge = Judge(folder, args.fresh, args.repo.resolve())
    for ledger in sorted(folder.glob('*/truth.json')):
        board = ledger.parent.name
        for name, truth in sorted(json.loads(ledger.read_text()).items()):
            if not fnmatch.fnmatch(f'{board}/{name}', args.only):
                continue
            diagnose = not args.no_diagnose and not name.startswith('m')
            judge.session(board, name, truth, diagnose)
            print(f'{board}/{name}', flush=True)
            (folder / 'results.md').write_text(report(folder) + '\n')
    print(report(folder))


if __name__ == '__main__':
    main()
