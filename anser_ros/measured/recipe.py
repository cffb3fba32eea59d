"""Defines a data set as a recipe: its sessions, the shipped commands run on them, the figures."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from anser_ros.measured import ReportRow


@dataclass(frozen=True)
class Recipe:
    """States what `anser measured` does with a data set.

    Attributes
    ----------
    name : str
        As `anser measured` calls the data set.
    write_sessions : callable
        From the folder of the data and that of the bags to the bags written there.
    commands : callable
        From the bags and the folder for results to the command lines, in their order: verb and
        arguments of `anser`, as anybody would type them.
    rows : callable
        From the folder of the data, the bags and the folder for results to the figures, read from
        what the commands wrote.
    folder : str
        Of the data, below ``measured/``; the name, unless another is given.
    """

    name: str
    write_sessions: Callable[[Path, Path], list[Path]]
    commands: Callable[[list[Path], Path], list[list[str]]]
    rows: Callable[[Path, list[Path], Path], list[ReportRow]]
    folder: str = ''

    def data(self, shared: Path) -> Path:
        """Return the folder of the data in the one that contains ``measured/``."""
        return shared / 'measured' / (self.folder or self.name)


def calibrations(bag: Path, out: Path, found: Sequence[str] = ()) -> list[list[str]]:
    """Return the commands that calibrate a session with sensors as stated, and as found.

    Their models and reports are ``plain`` and ``full``; ``found`` are the options of the second.
    """
    return [
        [
            'calibrate', str(bag), *options, '--out', str(out / f'{kind}.yaml'),
            '--report', str(out / kind),
        ]
        for kind, options in (('plain', ('--estimate', 'none')), ('full', found))
    ]  # fmt: skip


def ran(folder: Path, name: str) -> dict[str, Any]:
    """Return the JSON document of this name that a command wrote into its folder."""
    document: dict[str, Any] = json.loads((folder / name).read_text(encoding='utf-8'))
    return document


def figure(document: dict[str, Any], *keys: str) -> float:
    """Return a number of a document by its keys; nan where it is null or not there."""
    value: Any = document
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return float('nan') if value is None else float(value)
