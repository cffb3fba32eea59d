"""Compare two evaluations of one session: errors frame by frame, and how often there is a pose.

Frames close in time share the causes of their errors, so whole stretches of time are resampled
(the moving-block idea of Künsch, Annals of Statistics 17, 1989), all coils of a stretch together.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from anser_ros.arrays import Array, Integers
from anser_ros.cli import output
from anser_ros.errors import ParameterError
from anser_ros.physics.constants import DEGREES
from anser_ros.pose_states import OK
from anser_ros.sessions import tracked_session as files
from anser_ros.wire.tables import Table, read_table
from anser_ros.wire.text_files import read_text

Key = tuple[int, str]

BLOCK_NS = 1_000_000_000
"""Length of a stretch that is resampled as one, ns: errors of a second ago are hardly related."""
DRAWS = 2000
"""Resamples: the ends of a 95 % interval then vary by a few percent of its width."""
INTERVAL_SHARE = 0.95
"""Share of the resamples that lie in the interval, as is usual in the field's publications."""
FEWEST_BLOCKS = 5
"""Stretches below which an interval means nothing: its ends would be those of single ones."""


@dataclass(frozen=True)
class Compared:
    """Compares errors, m or rad, or shares of frames with a pose, 0 to 1, of one coil or body.

    ``low`` and ``high`` are the interval of the difference, second less first, NaN where stretches
    are too few. ``n`` frames are those of both; those that only one of the two has are counted.
    """

    low: float
    high: float
    n: int
    only_a: int
    only_b: int
    a: float  # root mean square error, or share
    b: float
    are_shares: bool

    @property
    def verdict(self) -> str:
        """Return which is better, ``a`` or ``b``; ``neither`` where both may be."""
        return {0: 'neither', 1 if self.are_shares else -1: 'b'}.get(self.sign, 'a')

    @property
    def sign(self) -> int:
        """Return the sign of the difference where the whole interval has one, else 0."""
        return int(self.low > 0) - int(self.high < 0)


def check_same_recording(first: Path, second: Path) -> None:
    """Raise `ParameterError` when two evaluations state that they are of different recordings."""
    one, two = _recording(first), _recording(second)
    if one and two and one != two:
        raise ParameterError(
            f'{first} and {second} are evaluations of two different recordings ({one}, {two}), '
            f'whose frames cannot be paired'
        )


def _recording(folder: Path) -> str:
    """What an evaluation says that it is of; empty where it does not, as older ones."""
    path = folder / 'evaluation.json'
    if not path.is_file():
        return ''
    try:
        return str(json.loads(read_text(path)).get('recording', ''))
    except (ValueError, AttributeError) as error:
        raise ParameterError(f'{path}: not a document of anser evaluate') from error


def read_errors(folder: Path) -> dict[str, dict[Key, float]]:
    """Return errors of position (m) and orientation (rad) by stamp and name; `ParameterError`."""
    keys, table = _read(folder, files.ERRORS_FILE, files.ERROR_COLUMNS)
    return {
        kind.partition('_')[0]: dict(zip(keys, table.array(kind).tolist(), strict=True))
        for kind in files.ERROR_COLUMNS[2:]
    }


def read_states(folder: Path) -> dict[Key, float]:
    """Return whether there is a pose, 1 or 0, by stamp and name; raises `ParameterError`."""
    found: dict[Key, float] = {}
    for name, columns in (
        (files.POSES_FILE, files.POSE_COLUMNS),
        (files.BODIES_FILE, files.BODY_COLUMNS),
    ):
        keys, table = _read(folder, name, columns)
        found |= zip(keys, map(float, table.words('status') == OK), strict=True)
    return found


def _read(folder: Path, name: str, columns: tuple[str, ...]) -> tuple[list[Key], Table]:
    """A table, and the stamp and the name in its second column of each row."""
    path = folder / name
    if not path.is_file():
        raise ParameterError(f'{folder}: no {name}; is it a folder of anser evaluate?')
    table = read_table(path, as_text=True)
    if table.names != columns:
        raise ParameterError(f'{path}: columns must be {", ".join(columns)}')
    stamps = table.array('stamp_ns').tolist()
    return list(zip(stamps, table.words(columns[1]), strict=True)), table


def compare(
    first: Mapping[Key, float],
    second: Mapping[Key, float],
    rng: np.random.Generator,
    *,
    are_shares: bool = False,
) -> dict[str, Compared]:
    """Compare errors of one kind by stamp and name, or whether there is a pose (`read_states`).

    Raises `ParameterError` when no frame of whole sessions is in both.
    """
    if are_shares and not first.keys() & second.keys():
        raise ParameterError('the two have no frame in common: are they of the same session?')
    shown, found = np.asarray if are_shares else np.sqrt, {}
    for name in dict.fromkeys(name for _, name in (*first, *second)):
        one, two = ({t: v for (t, n), v in side.items() if n == name} for side in (first, second))
        both = sorted(one.keys() & two.keys())
        pairs = np.array([[side[stamp] for stamp in both] for side in (one, two)])
        pairs = pairs if are_shares else pairs**2
        low, high = _interval(np.array(both, dtype=np.int64), pairs, rng, shown)
        a, b = shown(pairs.mean(axis=1)).tolist() if both else (np.nan, np.nan)
        alone = len(one) - len(both), len(two) - len(both)
        found[name] = Compared(low, high, len(both), *alone, a, b, are_shares)
    return found


def _interval(
    stamps: Integers, values: Array, rng: np.random.Generator, shown: Callable[[Array], Array]
) -> tuple[float, float]:
    """The interval of the difference of two means, as they are shown, by resampled stretches."""
    if not stamps.size:
        return np.nan, np.nan
    _, block = np.unique((stamps - stamps[0]) // BLOCK_NS, return_inverse=True)
    count = int(block.max()) + 1
    if count < FEWEST_BLOCKS:
        return np.nan, np.nan
    sums = np.array([np.bincount(block, weights=row) for row in values])
    sizes = np.bincount(block)
    drawn = rng.integers(0, count, size=(DRAWS, count))
    means = sums[:, drawn].sum(axis=2) / sizes[drawn].sum(axis=1)
    difference = np.diff(shown(means), axis=0)[0]
    tail = 50.0 * (1.0 - INTERVAL_SHARE)
    low, high = np.percentile(difference, (tail, 100.0 - tail))
    return float(low), float(high)


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
