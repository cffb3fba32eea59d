"""Reads tables of numbers from CSV, NumPy and MATLAB files, and columns of them by name."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ParameterError

REFERENCE = re.compile(r'^\s*([^\[\]]+?)\s*(?:\[([\d\s,]+)\])?\s*$')
"""A column: a name, and where that is an array of more dimensions, the further indices."""
ENDINGS = ('.csv', '.npy', '.npz', '.mat')


@dataclass(frozen=True)
class NumberTable:
    """Holds the arrays of one file by name; the first index of each counts rows.

    A CSV file has one for each column, a ``.npy`` file one called ``data``.
    """

    path: Path
    arrays: Mapping[str, NDArray[Any]]

    def array(self, name: str) -> NDArray[Any]:
        """Return the whole array of a name; `ParameterError` where there is none."""
        if name not in self.arrays:
            known = ', '.join(list(self.arrays)[:20])
            raise ParameterError(f'{self.path}: no {name!r}; there are: {known}')
        return self.arrays[name]

    def column(self, reference: Any) -> NDArray[Any]:
        """Return one column, shape (N,), such as ``time``, ``flux[3]`` or ``flux[0, 3]``.

        Raises
        ------
        ParameterError
            When there is no such name, or what it names is no column.
        """
        match = REFERENCE.match(str(reference))
        if match is None:
            raise ParameterError(f'{self.path}: {reference!r} is not a column, such as x or x[3]')
        found = self.array(match[1])
        rest = tuple(int(i) for i in match[2].split(',')) if match[2] else ()
        if found.ndim == 2 and 1 in found.shape and not rest:  # MATLAB has no plain vectors
            found = found.ravel()
        if found.ndim != 1 + len(rest):
            raise ParameterError(
                f'{self.path}: {match[1]} has shape {found.shape}, so {reference} is not a column'
            )
        if any(i >= n for i, n in zip(rest, found.shape[1:], strict=True)):
            raise ParameterError(f'{self.path}: {reference} is beyond shape {found.shape}')
        index: tuple[Any, ...] = (slice(None), *rest)
        return np.asarray(found[index])

    def columns(self, references: Any, count: int, what: str) -> NDArray[Any]:
        """Return several columns as an array of shape (N, count)."""
        if not isinstance(references, list) or len(references) != count:
            raise ParameterError(f'{self.path}: {what} needs a list of {count} columns')
        return np.stack([self.column(reference) for reference in references], axis=1)


def read_table(path: Path) -> NumberTable:
    """Read a file; MATLAB's before version 7.3 by scipy, later ones, which are HDF5, by h5py.

    Raises
    ------
    ParameterError
        When it is of another kind, or cannot be read.
    """
    if not path.is_file():
        raise ParameterError(f'{path}: {"is a folder" if path.is_dir() else "no such file"}')
    try:
        if path.suffix == '.csv':
            return NumberTable(path, _csv(path))
        if path.suffix == '.npy':
            return NumberTable(path, {'data': np.load(path, allow_pickle=False)})
        if path.suffix == '.npz':
            with path.open('rb') as stream, np.load(stream, allow_pickle=False) as loaded:
                return NumberTable(path, dict(loaded))
        if path.suffix == '.mat':
            return NumberTable(path, _mat(path))
    except (OSError, ValueError, EOFError, OverflowError, BadZipFile) as error:
        if 'pickle' in str(error):  # numpy's advice would be to load it all the same
            raise ParameterError(f'{path}: no arrays of numbers') from error
        raise ParameterError(f'{path}: cannot be read: {" ".join(str(error).split())}') from error
    raise ParameterError(f'{path}: ends with none of {", ".join(ENDINGS)}')


def _csv(path: Path) -> dict[str, NDArray[Any]]:
    with path.open(encoding='utf-8-sig', newline='') as stream:
        reader = csv.reader(stream)
        head = [name.strip() for name in next(reader, [])]
        rows = [row for row in reader if row]
    for number, row in enumerate(rows, start=2):
        if len(row) != len(head):
            raise ValueError(f'row {number} has {len(row)} cells, the head {len(head)}')
    return {name: _numbers([row[i].strip() for row in rows]) for i, name in enumerate(head)}


def _numbers(cells: list[str]) -> NDArray[Any]:
    """Whole numbers as such: stamps in ns have more digits than a float keeps."""
    if all(re.fullmatch(r'[+-]?\d+', cell) for cell in cells):
        return np.array([int(cell) for cell in cells], dtype=np.int64)
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)  # words; who asks for numbers of them gets an error


def _mat(path: Path) -> dict[str, NDArray[Any]]:
    import h5py  # late, as few need it

    if not h5py.is_hdf5(path):
        from scipy.io import loadmat

        loaded = loadmat(path)
        return {k: v for k, v in loaded.items() if not k.startswith('__')}
    arrays = {}
    with h5py.File(path, 'r') as file:
        for name, item in file.items():
            if isinstance(item, h5py.Dataset):
                value = item[()]
                if value.dtype.names == ('real', 'imag'):
                    value = value['real'] + 1j * value['imag']
                arrays[name] = value.T  # MATLAB counts the first index fastest
    return arrays
