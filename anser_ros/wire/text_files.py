"""Reads text files from anybody: one clear line for a file that is no text, or cannot be read."""

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import AnserError, ParameterError


def read_text(path: str | os.PathLike[str], kind: type[AnserError] = ParameterError) -> str:
    """Return the text of a file, without the mark that some editors put at its beginning.

    Raises
    ------
    AnserError
        Of the kind that is asked for, when it cannot be read, or is no text in UTF-8.
    """
    try:
        return Path(path).read_text(encoding='utf-8-sig')
    except OSError as error:
        raise kind(f'{os.fspath(path)}: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise kind(f'{os.fspath(path)}: not a text in UTF-8') from error


def read_rows(path: str | os.PathLike[str]) -> tuple[list[str], list[dict[str, str]]]:
    """Return the names in the head of a CSV file, and its rows by these names.

    Raises
    ------
    ParameterError
        When it cannot be read, or is no CSV in UTF-8.
    """
    reader = csv.DictReader(io.StringIO(read_text(path), newline=''))
    try:
        rows = list(reader)
    except csv.Error as error:
        raise ParameterError(f'{os.fspath(path)}: no table: {error}') from error
    return list(reader.fieldnames or []), rows


def numbers_of(
    path: str | os.PathLike[str],
    rows: Sequence[dict[str, str]],
    names: Sequence[str],
    *,
    with_gaps: bool = False,
) -> NDArray[np.float64]:
    """Return columns of a table's rows as numbers, shape (rows, names).

    Raises
    ------
    ParameterError
        When a column is missing or a cell is no finite number; ``with_gaps`` empty ones are NaN.
    """
    try:
        values = np.array(
            [[float((row[n] or 'nan') if with_gaps else row[n]) for n in names] for row in rows]
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError(
            f'{os.fspath(path)}: needs the columns {", ".join(names)} with numbers: {error}'
        ) from error
    if not (with_gaps or np.isfinite(values).all()):
        raise ParameterError(f'{os.fspath(path)}: the columns {", ".join(names)} must be finite')
    return values
