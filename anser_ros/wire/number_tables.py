"""Reads arrays of numbers by name: columns of tables, arrays of NumPy's and MATLAB's files."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ParameterError
from anser_ros.wire.tables import Table, read_table

REFERENCE = re.compile(r'^\s*([^\[\]]+?)\s*(?:\[([\d\s,]+)\])?\s*$')
"""A column: a name, and where that is an array of more dimensions, the further indices."""
TEXTS = ('.csv', '.tsv', '.txt', '.tum')
ENDINGS = (*TEXTS, '.npy', '.npz', '.mat')


@dataclass(frozen=True)
class NumberTable:
    """Holds the arrays of one file by name; the first index of each counts rows.

    A text has one for each column, a ``.npy`` file one called ``data``.
    """

    path: Path
    arrays: Mapping[str, NDArray[Any]]
    table: Table | None = None  # of a text, whose columns are read as they are asked for

    def array(self, name: str) -> NDArray[Any]:
        """Return the whole array of a name; `ParameterError` where there is none."""
        if self.table is not None:
            return self.table.array(name)
        if name not in self.arrays:
            known = ', '.join(list(self.arrays)[:20])
            raise ParameterError(f'{self.path}: no {name!r}; there are: {known}')
        return self.arrays[name]

    def _parts(self, reference: Any) -> tuple[str, str]:
        """Name of an array and its further indices; what is a column's name as a whole is that."""
        text = str(reference)
        if text in (self.arrays if self.table is None else self.table.names):
            return text, ''
        if (match := REFERENCE.match(text)) is None:
            raise ParameterError(f'{self.path}: {reference!r} is not a column, such as x or x[3]')
        return match[1], match[2] or ''

    def column(self, reference: Any) -> NDArray[Any]:
        """Return a column (N,): ``time``, ``flux[0, 3]``; raises `ParameterError` for no such."""
        name, indices = self._parts(reference)
        found = self.array(name)
        rest = tuple(int(i) for i in indices.split(',')) if indices else ()
        if found.ndim == 2 and 1 in found.shape and not rest:  # MATLAB has no plain vectors
            found = found.ravel()
        if found.ndim != 1 + len(rest):
            raise ParameterError(
                f'{self.path}: {name} has shape {found.shape}, so {reference} is not a column'
            )
        if any(i >= n for i, n in zip(rest, found.shape[1:], strict=True)):
            raise ParameterError(f'{self.path}: {reference} is beyond shape {found.shape}')
        index: tuple[Any, ...] = (slice(None), *rest)
        return np.asarray(found[index])

    def columns(self, references: Any, count: int, what: str, beside: Any) -> NDArray[Any]:
        """Return several columns (N, count), as long as another one; raises `ParameterError`."""
        if not isinstance(references, list) or len(references) != count:
            raise ParameterError(f'{self.path}: {what} needs a list of {count} columns')
        many = len(self.column(beside))
        for reference in references:
            if (found := len(self.column(reference))) != many:
                words = f'{beside} has {many} rows, {reference} {found}'
                if many in self.array(self._parts(reference)[0]).shape[1:]:
                    words += f'; its rows are {many} along the other axis: transpose it'
                raise ParameterError(f'{self.path}: {words}')
        return np.stack([self.column(reference) for reference in references], axis=1)


def read_arrays(path: Path) -> NumberTable:
    """Read a file, MATLAB's of version 7.3 (HDF5) by h5py; raises `ParameterError`."""
    if not path.is_file():
        raise ParameterError(f'{path}: {"is a folder" if path.is_dir() else "no such file"}')
    try:
        if path.suffix.lower() in TEXTS:
            return NumberTable(path, {}, read_table(path))
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
