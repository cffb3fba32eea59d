"""Compare two evaluations of one session, frame by frame, with bootstrap intervals."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from rich.console import Console
from rich.table import Table

matplotlib.use('Agg')
import matplotlib.pyplot as plt

from anser_ros.cli.output import make_folder, say_written
from anser_ros.sessions.comparison import Compared, compare_errors, read_errors

SCHEMA = 'anser_comparison/1'
SEED = 1
"""Seed of the resamples, so that the same folders give the same intervals."""
KINDS = (('position', 1e3, 'mm'), ('orientation', 57.29578, 'deg'))
"""What is compared, with the factor to the unit that is shown."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = 'example: anser compare frozen/ refit/ --out compared/'
    parser.add_argument('first', type=Path, help='folder that anser evaluate has written')
    parser.add_argument('second', type=Path, help='another one, of the same session')
    parser.add_argument(
        '--out',
        type=Path,
        help='folder for comparison.json and comparison.png, made if missing',
    )
    parser.add_argument('--json', action='store_true', help='print comparison.json on stdout')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    if args.out is not None:
        make_folder(args.out)
    with Console(stderr=True).status('resampling'):
        one, two = read_errors(args.first), read_errors(args.second)
        rng = np.random.default_rng(SEED)
        found = {kind: compare_errors(one[kind], two[kind], rng) for kind, _, _ in KINDS}
    document: dict[str, Any] = {
        'schema': SCHEMA, 'first': str(args.first), 'second': str(args.second),
        **{kind: {name: _plain(c) for name, c in found[kind].items()} for kind in found},
    }  # fmt: skip
    text = json.dumps(document, indent=1)
    if args.out is not None:
        (args.out / 'comparison.json').write_text(text + '\n', encoding='utf-8')
        draw(found, args.out / 'comparison.png')
    if args.json:
        print(text)
        return 0
    for kind, scale, unit in KINDS:
        Console().print(_table(found[kind], f'{kind}, {unit}', scale))
    if args.out is not None:
        say_written(args.out / 'comparison.json', args.out / 'comparison.png')
    return 0


def _plain(one: Compared) -> dict[str, Any]:
    """Plain data; null where there is no number."""
    values = {key: None if value != value else value for key, value in asdict(one).items()}
    return {**values, 'better': one.verdict}


def _table(found: dict[str, Compared], title: str, scale: float) -> Table:
    table = Table(
        'name', 'pairs', 'only first', 'only second', 'first', 'second', 'second - first, 95 %',
        'better', title=title,
    )  # fmt: skip
    words = {'a': 'first', 'b': 'second', 'neither': '-'}
    for name, one in found.items():
        low, high = scale * one.low, scale * one.high
        interval = '-' if np.isnan(low) else f'{low:+.4f} .. {high:+.4f}'
        roots = [f'{scale * value:.4f}' for value in (one.rmse_a, one.rmse_b)]
        counts = [str(value) for value in (one.n, one.only_a, one.only_b)]
        table.add_row(name, *counts, *roots, interval, words[one.verdict])
    return table


def draw(found: dict[str, dict[str, Compared]], path: Path) -> None:
    """Draw the difference of each name's errors with its interval; left of zero is better."""
    names = list(found['position'])
    figure, panels = plt.subplots(
        1, 2, figsize=(9, 1.4 + 0.3 * len(names)), layout='constrained', sharey=True
    )
    for panel, (kind, scale, unit) in zip(panels, KINDS, strict=True):
        for row, one in enumerate(found[kind].values()):
            middle = scale * (one.rmse_b - one.rmse_a)
            panel.plot(middle, row, 'o', color='C0')
            if np.isfinite(one.low):
                panel.hlines(row, scale * one.low, scale * one.high, color='C0')
        panel.axvline(0.0, color='0.5')
        panel.set_xlabel(f'{kind} RMSE, second - first, {unit}')
        panel.grid(alpha=0.3, axis='x')
        panel.locator_params(axis='x', nbins=5)
        panel.set_ylim(len(names) - 0.5, -0.5)
    panels[0].set_yticks(np.arange(len(names)), names)
    figure.savefig(path, dpi=110, metadata={'Software': None})
    plt.close(figure)
