"""Reads tables of anybody: finds their dialect and their header, and refuses what is not clear.

A table is a text with a header of names, or with numbers alone. Separators, decimal commas,
quotes, encodings, titles, rows of units and headers of several lines are found in the text itself;
pandas splits and converts the cells, and is imported only where a table is read.
"""

import csv
import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, Integers
from anser_ros.errors import ParameterError
from anser_ros.wire.table_names import LENGTH_M, is_unit, meaning_of, triples
from anser_ros.wire.text_files import read_text

SEPARATORS = ('\t', ';', ',', '|', None)
"""Between cells, in the order in which they are preferred; None: any blanks."""
COMMENTS = ('#', '%')
TITLE_LINES = 60
"""Lines in which the first row of numbers is looked for."""
GAPS = ('', '-', '--', 'na', 'n/a', '#n/a', 'nan', 'null', 'none')
"""Words for no number."""
_NUMBER, _WHOLE = r'[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?', r'[-+]?\d{1,18}|1\d{18}'
_DATE = r'\d{4}-\d\d-\d\d[T ]\d\d:\d\d'
_IS_NUMBER = re.compile(_NUMBER, re.IGNORECASE).fullmatch
_COMMA = re.compile(r'(?<=\d),(?=\d+(?:e[-+]?\d+)?$)', re.IGNORECASE)  # of a decimal


@dataclass(frozen=True)
class Table:
    """Holds the cells of a table as texts, empty for a gap: a data frame of pandas, with the names
    of the header, or numbers of columns from 1 on, and with the rows' lines in the file.

    ``titles`` are the cells of the lines above the header.
    """

    path: str
    cells: Any
    units: tuple[str, ...]
    has_names: bool
    titles: list[list[str]]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self.cells.columns)

    def words(self, name: str) -> Any:
        """Return a column as a series of texts, by its name in any case; `ParameterError`."""
        alike = [known for known in self.names if known.casefold() == name.casefold()]
        if not alike:
            raise ParameterError(f'{self.path}: no {name!r}; there are: {", ".join(self.names)}')
        return self.cells[name if name in alike else alike[0]]

    def array(self, name: str) -> NDArray[Any]:
        """Return a column (n,): whole numbers as such, others with NaN for a gap.

        Dates by ISO 8601 become ns since 1970; without a zone they are of UTC. Raises
        `ParameterError` for a word, with its line.
        """
        words = self.words(name)
        if words.str.fullmatch(_WHOLE).all():
            return np.asarray(words.astype(np.int64))
        if words.str.match(_DATE).all():
            return _nanoseconds(words, f'{self.path}: {name}')
        words = words.mask(words.str.casefold().isin(GAPS), 'nan')
        if len(bad := words[~words.str.fullmatch(f'{_NUMBER}|[-+]?inf|nan', case=False)]):
            is_time = ':' in bad.iloc[0]
            remedy = (
                'give times in s or as 2025-10-09T08:53:20.000Z'
                if is_time else 'leave the cell empty where there is none'
            )  # fmt: skip
            raise ParameterError(
                f'{self.path}: line {bad.index[0]}: {name} is {bad.iloc[0]!r}, which is no '
                f'number; {remedy}'
            )
        return np.asarray(words.astype(np.float64))

    def numbers(self, names: Sequence[str], *, with_gaps: bool = False) -> Array:
        """Return columns (n, k) as numbers, with gaps as NaN if allowed; `ParameterError`."""
        values = np.stack([self.array(name).astype(np.float64) for name in names], axis=1)
        bad = np.argwhere(~np.isfinite(values))
        if bad.size and not with_gaps:
            row, column = bad[0]
            line = self.cells.index[row]
            raise ParameterError(f'{self.path}: line {line}: {names[column]} must be finite')
        return values

    def positions(self, prefix: str = '', *, with_gaps: bool = False) -> Array:
        """Return the columns x, y, z of a prefix as positions (n, 3), m; raises `ParameterError`.

        Their names, or a row of units, state the unit: ``x_mm``, ``true_x_m``.
        """
        found = list(map(meaning_of, self.names, self.units))
        axes = triples(self.names, found)['place'].get((prefix,) if prefix else (), {})
        units = {found[column].unit for column in axes.values()}
        if not set('xyz') <= set(axes) or len(units) > 1 or not units <= set(LENGTH_M):
            begin = f'{prefix}_' if prefix else ''
            wanted = (', '.join(f'{begin}{a}_{u}' for a in 'xyz') for u in ('m', 'mm'))
            raise ParameterError(
                f'{self.path}: needs the columns {", or ".join(wanted)}; there are: '
                f'{", ".join(self.names)}'
            )
        names = [self.names[axes[axis]] for axis in 'xyz']
        return LENGTH_M[units.pop()] * self.numbers(names, with_gaps=with_gaps)


def _nanoseconds(words: Any, what: str) -> Integers:
    import pandas

    try:
        dates = pandas.to_datetime(words, utc=True, format='ISO8601').dt.tz_localize(None)
    except ValueError as error:
        raise ParameterError(f'{what} has a date that is none: {error}') from error
    return np.asarray(dates.to_numpy(dtype='datetime64[ns]').astype(np.int64))


def check_rising(path: str | os.PathLike[str], time: Array, lines: Sequence[int]) -> None:
    """Refuse times (n,), s, that fall back to where they began; ``lines`` in the file (n,).

    Sorted, they would make a gap that never was. Raises `ParameterError`.
    """
    known = np.flatnonzero(np.isfinite(time))
    steps = np.diff(time[known], append=np.inf)[:-1]
    row, most = (int(np.argmin(steps)), steps.max()) if steps.size else (0, 0.0)
    is_back = steps.size and time[known[row + 1]] <= time[known[0]] + most
    if is_back and -steps[row] > max(most, 1.0):  # less than a second is a matter of order
        raise ParameterError(
            f'{path}: line {lines[known[row + 1]]}: the time falls by {-steps[row]:.4g} s, more '
            'than it ever rises: a counter that wrapped, or a second recording? Let it go on, or '
            'give each recording its own file'
        )


Span = tuple[str, str | os.PathLike[str], float, float]
"""Name of a sensor, file, first and last time, s."""


def check_apart(seen: list[Span], name: str, path: str | os.PathLike[str], time: Array) -> None:
    """Refuse times (n,), s, of a sensor among those of another file; else add them to ``seen``."""
    known = time[np.isfinite(time)]
    first, last = known.min(initial=np.inf), known.max(initial=-np.inf)
    for other, file, begin, end in seen:
        if other == name and max(first, begin) < min(last, end):
            words = f'{file} and {path} both give {name}, at the same times'
            raise ParameterError(f'{words}: give one of them another name, or import it alone')
    seen.append((name, path, first, last))


def read_table(path: str | os.PathLike[str], *, as_text: bool = False) -> Table:
    """Read a table; of one ``as_text``, such as of names, the first line is the header.

    Raises `ParameterError` for a file that cannot be read, has no row of numbers, several columns
    of a name, or a row of another length than its header, with its line.
    """
    name = os.fspath(path)
    text = read_text(path, any_letters=True).replace('\N{MINUS SIGN}', '-')
    every = [(n, line.strip(' ')) for n, line in enumerate(text.splitlines(), 1)]
    lines = [one for one in every if one[1].strip('\t ,;|') and not one[1].startswith(COMMENTS)]
    texts = [line for _, line in lines]
    if not lines:
        raise ParameterError(f'{name}: no rows')
    separator, first = _find_rows(texts)
    if as_text:
        separator, first = max(SEPARATORS[:-1], key=lambda s: len(_cells(texts[0], s))), 1
    elif first == len(lines):
        raise ParameterError(f'{name}: no row of numbers; it begins with {texts[0][:60]!r}')
    above = [_cells(line, separator) for line in texts[:first]]
    width = len(_cells(texts[min(first, len(lines) - 1)], separator))
    head, units = _header(above, width)
    if not above:  # names may stand behind the mark of a comment
        notes = (line.strip('#% ') for _, line in reversed(every) if line.startswith(COMMENTS))
        head = next((f for note in notes if len(f := _cells(note, separator)) == width), [])
    elif not head:
        raise ParameterError(
            f'{name}: line {lines[first - 1][0]}, {texts[first - 1][:60]!r}, does not name the '
            f'{width} columns; write # before a line that is a title'
        )
    names = head or [str(i + 1) for i in range(width)]
    twice = [known for known, many in Counter(filter(None, names)).items() if many > 1]
    if twice:
        raise ParameterError(f'{name}: several columns are called {", ".join(twice)}')
    cells = _split(name, lines[first:], separator, names)
    if head:
        cells = cells[(cells != head).any(axis=1)]  # it may stand once more
    stated = (*units, *([''] * len(names)))[: len(names)]
    return Table(name, cells, stated, bool(head), above)


def _split(
    path: str, lines: list[tuple[int, str]], separator: str | None, names: list[str]
) -> Any:
    """The cells of numbered lines by names; `ParameterError` for a line of another length."""
    import pandas  # late: it takes half a second, and few commands read a table

    count, rows = len(names), [_cells(line, separator) for _, line in lines]
    columns = dict(enumerate(zip_longest(names, *rows)))
    cells = pandas.DataFrame(columns, [0, *(n for n, _ in lines)], dtype=object)[1:]
    lacks = cells.iloc[:, :count].isna().any(axis=1)
    lacks[-1:] = False  # it may be cut
    wrong = lacks | (cells.iloc[:, count:].fillna('') != '').any(axis=1)
    if wrong.any():
        size = cells.loc[line := wrong.idxmax()].notna().sum()
        raise ParameterError(f'{path}: line {line} has {size} cells, the header {count}')
    cells = cells.iloc[:, :count].fillna('').set_axis(names, axis=1)
    return cells if separator == ',' else cells.replace(_COMMA, '.', regex=True)


def _cells(line: str, separator: str | None) -> list[str]:
    if separator is not None and '"' in line:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    else:
        cells = line.split(separator)
    return [cell.strip() for cell in cells]


def _find_rows(lines: list[str]) -> tuple[str | None, int]:
    """The separator with which most cells are numbers, and the first line with as many."""

    def count(line: str, separator: str | None) -> int:
        cells = _cells(line, separator)
        if separator != ',':
            cells = [_COMMA.sub('.', cell) for cell in cells]
        return sum(map(bool, map(_IS_NUMBER, cells)))

    sample = lines[len(lines) // 2 :][:20]
    separator = max(SEPARATORS, key=lambda s: sum(count(line, s) for line in sample))
    usual = float(np.median([count(line, separator) for line in sample]))
    counts = [count(line, separator) for line in lines[:TITLE_LINES]]
    first = next((i for i, n in enumerate(counts) if n >= max(0.6 * usual, 1.0)), len(lines))
    if first == len(lines):
        return separator, first
    width = len(_cells(lines[first], separator))
    # Rows with gaps may come before the first whole one.
    while first and counts[first - 1] and len(_cells(lines[first - 1], separator)) == width:
        first -= 1
    return separator, first


def _header(above: list[list[str]], width: int) -> tuple[list[str], list[str]]:
    """Names and units of the columns, from the lines above the rows; empty where none has them."""
    units: list[str] = []
    if len(above) > 1 and all(map(is_unit, above[-1])):
        *above, last = above
        units = [re.sub(r'[\W_]', '', cell).casefold() for cell in last]
    head = above[-1] if above else []
    if len(head) < max(width - 1, 2):  # rows may end with a separator, the last may be cut
        return [], []
    named = [name for name in head if name]
    if len(set(named)) < len(named):  # bodies and kinds stand above the axes
        same = [
            row[: len(head)] for row in above[:-1]
            if len(row) >= len(head) and not any(map(_IS_NUMBER, row))
        ]  # fmt: skip
        head = [' '.join(filter(None, column)) for column in zip(*same, head, strict=True)]
    return head, units


MARKUPS = ('.fcsv', '.mrk.json')
"""Endings of 3D Slicer's lists of points."""
AXES = {'RAS': (1.0, 1.0, 1.0), 'LPS': (-1.0, -1.0, 1.0)}
"""Signs that turn a list's axes into right, anterior, superior; older lists count both from 0."""


def read_points(path: Path) -> Array:
    """Return the points (n, 3), m, of a table of x, y, z or of a list of 3D Slicer.

    A list of 3D Slicer is returned in the axes right, anterior, superior, whichever it has; gaps
    of a table are NaN. Raises `ParameterError`.
    """
    if not path.name.lower().endswith(MARKUPS):
        return read_table(path).positions(with_gaps=True)
    text = read_text(path, any_letters=True)
    if path.suffix.lower() == '.json':
        try:
            (markups,) = json.loads(text)['markups']
            system, unit = markups.get('coordinateSystem', 'LPS'), markups['coordinateUnits']
            points = markups['controlPoints']
            places = np.array([point['position'] for point in points], np.float64).reshape(-1, 3)
            is_set = [point.get('positionStatus', 'defined') == 'defined' for point in points]
            places[np.logical_not(is_set)] = np.nan
            scaled = LENGTH_M[unit if isinstance(unit, str) else unit[0]] * places
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            words = 'no list of points of 3D Slicer with coordinateUnits and controlPoints'
            raise ParameterError(f'{path}: {words}') from error
    else:
        stated = re.search(r'CoordinateSystem\s*=\s*(\w+)', text)
        system, table = stated[1] if stated else 'RAS', read_table(path)
        scaled = 1e-3 * table.numbers('xyz' if table.has_names else '234')
    axes = dict(zip('01', AXES, strict=True)).get(str(system), str(system).upper())
    if axes not in AXES:
        raise ParameterError(f'{path}: points in {system}: save them in RAS or LPS')
    return np.asarray(scaled * AXES[axes])
