"""Keeps tables of refits, seconds of work, on disk while model, setup and code are the same."""

import functools
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.fingerprint import fingerprint_of
from anser_ros.kernel_cache import PACKAGE
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.tables import RefitTables, arrays_of, tables_of
from anser_ros.sessions.nominal_board import NominalBoard, stated_volume
from anser_ros.wire.setup import Setup

TABLES = 'refit_tables_'
"""How the names of files with tables begin."""
MOST_TABLES = 3
"""Files of tables that are kept, the last used: each has about 140 MB."""
DAMAGED = (OSError, EOFError, ValueError, KeyError, TypeError, FitError, BadZipFile)
"""What the reading of a file raises that is not there, cut, or another one's."""


def kept_folder(is_wanted: bool = True) -> Path | None:
    """Return the folder of this user in which files are kept; None where they are not to be."""
    if not is_wanted:
        return None
    base = os.environ.get('XDG_CACHE_HOME') or '~/.cache'
    return Path(base).expanduser() / 'anser_ros'


class KeptTables:
    """Keeps the tables of one model, setup and set of references, which are the tables' own."""

    def __init__(
        self, folder: Path, setup: Setup, model: FieldModel, references: SensorTable
    ) -> None:
        self._given = setup, model, references
        places = [getattr(references, f.name) for f in fields(references)]
        made_by, stated = [np.__version__, _code()], dict(setup.stated)
        key = fingerprint_of(
            [made_by, setup.identity.board, setup.volume, stated, model.fingerprint, places]
        )
        self._folder, self._path = folder, folder / f'{TABLES}{key}'

    def read(self) -> RefitTables | None:
        """Return the tables; None where there are none, or the file is damaged."""
        setup, model, references = self._given
        drawing, volume = NominalBoard.of(setup).field, stated_volume(setup)
        try:
            arrays = read_arrays(self._path)
            os.utime(self._path)
            return tables_of(arrays, model, references, setup.refit, drawing, volume)
        except DAMAGED:
            return None

    def write(self, tables: RefitTables) -> None:
        """Keep the tables, and drop those that were not used for longest; raises `OSError`."""
        if not self._path.exists():
            write_arrays(self._path, arrays_of(tables))
        files = sorted(self._folder.glob(f'{TABLES}*'), key=used_s, reverse=True)
        for old in files[MOST_TABLES:]:
            old.unlink(missing_ok=True)


@functools.cache
def _code() -> str:
    """The fingerprint of the code that computes tables, the same in every copy of the package."""
    return fingerprint_of(
        {str(f.relative_to(PACKAGE)): f.read_text('utf-8') for f in PACKAGE.rglob('*.py')}
    )


def used_s(path: Path) -> float:
    """Return when a file was last used, s since 1970; 0 if it has gone."""
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file; raises what `DAMAGED` lists."""
    with path.open('rb') as file, np.load(file) as arrays:
        return dict(arrays)


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a file that is whole or not there; raises `OSError`."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    part = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        with part.open('wb') as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
