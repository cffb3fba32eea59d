"""What a fault is, and what a hostile input to a command is."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rig import Rig

Off = Callable[[], object]
"""Takes a fault away again."""
On = Callable[[Rig, np.random.Generator], Off]
"""Puts a fault on a running chain, and returns what takes it away."""


class Fault(NamedTuple):
    """One fault of the trial."""

    name: str  # for the command line
    what: str  # for the table
    on: On
    lasts_s: float = 3.0  # two or three rounds of diagnostics
    world: str = 'clean'  # simulated world that it happens in
    combines: bool = False  # whether it may be drawn together with others
    spoils: bool = False  # whether the chain is started anew, since somebody keeps what it said


class Command(NamedTuple):
    """A hostile or implausible input to a command, which has to refuse it in one line."""

    name: str
    what: str
    arguments: Callable[[Path], list[object]]  # makes the input in a folder; those of `anser`
    says: str  # a word that its answer has to have


def nothing() -> None:
    """Take nothing away: what a fault leaves when it has gone by itself."""
