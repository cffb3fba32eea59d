"""Compare two evaluations of one session: errors frame by frame, and how often there is a pose."""

import argparse
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from anser_ros.apps.lab.comparison import (
    Compared,
    check_same_recording,
    compare,
    read_errors,
    read_states,
)
from anser_ros.cli import output
from anser_ros.physics.constants import DEGREES

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
    output.add_out(parser, 'comparison.json and comparison.png', required=False)
    output.add_json(parser, 'comparison.json on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Compare the two evaluations."""
    output.make_folder(args.out)
    check_same_recording(args.first, args.second)
    one, two = read_errors(args.first), read_errors(args.second)
    tell('resampling')
    rng = np.random.default_rng(SEED)
    found = {kind: compare(one[kind], two[kind], rng) for kind, _, _ in KINDS}
    states = read_states(args.first), read_states(args.second)
    shares = compare(*states, rng, are_shares=True)
    everything = {**found, 'coverage': shares}
    document: dict[str, Any] = {
        'schema': SCHEMA, 'first': str(args.first), 'second': str(args.second),
        **{kind: {name: _plain(c) for name, c in all_of.items()}
           for kind, all_of in everything.items()},
    }  # fmt: skip
    picture = None if args.out is None else draw(found, shares)
    written = output.write_files(
        args.out, {'comparison.json': document, 'comparison.png': picture}
    )
    ends = ['first', 'second', 'difference, 95 %', 'better']
    tables = [
        output.terminal_table(['name', 'pairs', *ends], _rows(found[kind], scale, 4),
                       title=f'{kind} error, RMSE, {unit}')
        for kind, scale, unit in KINDS
    ]  # fmt: skip
    rows = _rows(shares, 100.0, 2)
    tables.append(
        output.terminal_table(['name', 'frames', *ends], rows, title='frames with a pose, %')
    )
    shown = (*tables, verdict(everything), alone(found['position']))
    return output.Result(document, (), shown, written)


def _plain(one: Compared) -> dict[str, Any]:
    """Plain data; null where there is no number."""
    kind = 'share' if one.are_shares else 'rmse'
    alone = {} if one.are_shares else {'only_a': one.only_a, 'only_b': one.only_b}
    values = {'low': one.low, 'high': one.high, 'n': one.n, **alone, f'{kind}_a': one.a}
    values[f'{kind}_b'] = one.b
    known = {key: None if value != value else value for key, value in values.items()}
    return {**known, 'better': one.verdict}


def verdict(found: Mapping[str, Mapping[str, Compared]]) -> str:
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


def _rows(found: Mapping[str, Compared], scale: float, digits: int) -> list[list[str]]:
    """Rows of a table of at most 80 columns."""
    rows = []
    for name, one in found.items():
        interval = f'{scale * one.low:+.{digits}f} .. {scale * one.high:+.{digits}f}'
        rows.append([
            name, str(one.n),
            *(output.number(value, scale, f'.{digits}f') for value in (one.a, one.b)),
            '-' if np.isnan(one.low) else interval, WORDS[one.verdict],
        ])  # fmt: skip
    return rows


def draw(found: Mapping[str, Mapping[str, Compared]], shares: Mapping[str, Compared]) -> Figure:
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
            row = names.index(name)
            panel.plot(scale * (one.b - one.a), row, 'o', color='C0')
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
    return figure
