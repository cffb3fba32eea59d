"""Compare two evaluations of one session: errors frame by frame, and how often there is a pose."""

import argparse
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.table import Table

from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import say_written
from anser_ros.cli.progress import progress_of
from anser_ros.physics.constants import DEGREES
from anser_ros.pictures import save
from anser_ros.sessions.comparison import (
    Compared,
    ComparedShares,
    check_same_recording,
    compare_errors,
    compare_shares,
    read_errors,
    read_states,
)

SCHEMA = 'anser_comparison/1'
SEED = 1
"""Seed of the resamples, so that the same folders give the same intervals."""
KINDS = (('position', 1e3, 'mm'), ('orientation', DEGREES, 'deg'))
"""What is compared, with the factor to the unit that is shown."""


WORDS = {'a': 'first', 'b': 'second', 'neither': '-'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser compare frozen/ refit/ --out compared/ (after anser evaluate '
        'bags/metal.mcap --model config/demo_model.yaml --out frozen/, and the same with '
        '--refit --baseline bags/scan.mcap --out refit/)'
    )
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
    with progress_of('comparing') as tell:
        check_same_recording(args.first, args.second)
        one, two = read_errors(args.first), read_errors(args.second)
        tell('resampling')
        rng = np.random.default_rng(SEED)
        found = {kind: compare_errors(one[kind], two[kind], rng) for kind, _, _ in KINDS}
        shares = compare_shares(read_states(args.first), read_states(args.second), rng)
    everything: dict[str, Mapping[str, Compared | ComparedShares]] = {**found, 'coverage': shares}
    document: dict[str, Any] = {
        'schema': SCHEMA, 'first': str(args.first), 'second': str(args.second),
        **{kind: {name: _plain(c) for name, c in all_of.items()}
           for kind, all_of in everything.items()},
    }  # fmt: skip
    text = json.dumps(document, indent=1)
    if args.out is not None:
        (args.out / 'comparison.json').write_text(text + '\n', encoding='utf-8')
        draw(found, shares, args.out / 'comparison.png')
    if args.json:
        print(text)
        return 0
    for kind, scale, unit in KINDS:
        Console().print(_errors(found[kind], f'{kind} error, RMSE, {unit}', scale))
    Console().print(_shares(shares))
    print(verdict(everything))
    print(alone(found['position']))
    if args.out is not None:
        say_written(args.out / 'comparison.json', args.out / 'comparison.png')
    return 0


def _plain(one: Compared | ComparedShares) -> dict[str, Any]:
    """Plain data; null where there is no number."""
    values = {key: None if value != value else value for key, value in asdict(one).items()}
    return {**values, 'better': one.verdict}


def verdict(found: Mapping[str, Mapping[str, Compared | ComparedShares]]) -> str:
    """State in a line for how many coils and bodies each is better, in error and in coverage."""
    words = {'position': 'position error', 'orientation': 'orientation error',
             'coverage': 'frames with a pose'}  # fmt: skip
    parts = []
    for kind, all_of in found.items():
        count = Counter(one.verdict for one in all_of.values())
        counted = [f'{WORDS[key]} better for {count[key]}' for key in 'ab' if count[key]]
        none = 'no difference' if any(one.n for one in all_of.values()) else 'nothing to compare'
        parts.append(f'{words[kind]}: {", ".join(counted) or none} of {len(all_of)}')
    return '; '.join(parts) + '. Errors are those of frames in which both have a pose.'


def alone(found: Mapping[str, Compared]) -> str:
    """State how many errors only one of the two has, as the other gave no pose there."""
    counts = [sum(getattr(one, side) for one in found.values()) for side in ('only_a', 'only_b')]
    counted = [f'{count} only the {WORDS[key]}' for key, count in zip('ab', counts, strict=True)]
    pairs = sum(one.n for one in found.values())
    return f'Both have {pairs} poses with an error; {", ".join(counted)} has.'


def _errors(found: Mapping[str, Compared], title: str, scale: float) -> Table:
    """One table of at most 80 columns."""
    table = Table('name', 'pairs', 'first', 'second', 'difference, 95 %', 'better', title=title)
    for name, one in found.items():
        cells = [_cell(scale * value, 4) for value in (one.rmse_a, one.rmse_b)]
        table.add_row(name, str(one.n), *cells, _interval(one, scale, 4), WORDS[one.verdict])
    return table


def _shares(found: Mapping[str, ComparedShares]) -> Table:
    heads = 'name', 'frames', 'first', 'second', 'difference, 95 %', 'better'
    table = Table(*heads, title='frames with a pose, %')
    for name, one in found.items():
        cells = [_cell(100 * value, 2) for value in (one.share_a, one.share_b)]
        table.add_row(name, str(one.n), *cells, _interval(one, 100.0, 2), WORDS[one.verdict])
    return table


def _cell(value: float, digits: int) -> str:
    return '-' if np.isnan(value) else f'{value:.{digits}f}'


def _interval(one: Compared | ComparedShares, scale: float, digits: int) -> str:
    if np.isnan(one.low):
        return '-'
    return f'{scale * one.low:+.{digits}f} .. {scale * one.high:+.{digits}f}'


def draw(
    found: Mapping[str, Mapping[str, Compared]],
    shares: Mapping[str, ComparedShares],
    path: Path,
) -> None:
    """Draw the differences of each name's errors and shares of poses with their intervals.

    Left of zero the second evaluation has smaller errors, and right of zero more poses.
    """
    names = list(shares)
    figure, panels = plt.subplots(
        1, 3, figsize=(12, 1.4 + 0.3 * len(names)), layout='constrained', sharey=True
    )
    drawn: list[tuple[Mapping[str, Any], float, str]] = [
        (found[kind], scale, f'{kind} RMSE, second - first, {unit}') for kind, scale, unit in KINDS
    ]
    drawn.append((shares, 100.0, 'frames with a pose, second - first, %'))
    for panel, (all_of, scale, label) in zip(panels, drawn, strict=True):
        if not any(one.n for one in all_of.values()):
            panel.text(0.5, 0.5, 'no frame in which\nboth have a pose', ha='center',
                       va='center', transform=panel.transAxes)  # fmt: skip
            panel.set(xticks=[], xlabel=label)
            continue
        for name, one in all_of.items():
            row, pair = names.index(name), asdict(one)
            first, second = (
                (pair['rmse_a'], pair['rmse_b']) if 'rmse_a' in pair
                else (pair['share_a'], pair['share_b'])
            )  # fmt: skip
            panel.plot(scale * (second - first), row, 'o', color='C0')
            if np.isfinite(one.low):
                panel.hlines(row, scale * one.low, scale * one.high, color='C0')
        if not any(one.sign or one.low != one.high for one in all_of.values()):
            panel.set_xlim(-1.0, 1.0)  # no difference at all has no scale of its own
        panel.axvline(0.0, color='0.5')
        panel.set_xlabel(label)
        panel.grid(alpha=0.3, axis='x')
        panel.locator_params(axis='x', nbins=5)
        panel.set_ylim(len(names) - 0.5, -0.5)
    panels[0].set_yticks(np.arange(len(names)), names)
    save(figure, path)
