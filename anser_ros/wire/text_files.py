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


def read_numbers(
    path: str | os.PathLike[str], names: Sequence[str], rows: Sequence[dict[str, str]]
) -> NDArray[np.float64]:
    """Return columns of a CSV file's rows as numbers, shape (rows, names); NaN for an empty cell.

    Raises
    ------
    ParameterError
        When a column is missing, or has something else than numbers.
    """
    try:
        return np.array([[float(row[name] or 'nan') for name in names] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError(
            f'{os.fspath(path)}: needs the columns {", ".join(names)} with numbers: {error}'
        ) from error
