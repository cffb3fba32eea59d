"""What a fault is, and the tables of all there are."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rig import Rig

Off = Callable[[], None]
"""Takes a fault away again."""
On = Callable[[Rig, np.random.Generator], Off]
"""Puts a fault on a running chain, and returns what takes it away."""
LASTS_S = 3.0
"""How long a fault lasts where its table says nothing, s: two or three rounds of diagnostics."""


@dataclass(frozen=True)
class Fault:
    """One fault of the trial.

    Attributes
    ----------
    name : str
        For the command line.
    what : str
        For the table.
    on : callable
        Puts it on.
    lasts_s : float
        How long it lasts.
    world : str
        Simulated world that it happens in.
    combines : bool
        Whether it may be drawn together with others.
    spoils : bool
        Whether the chain is started anew after it, since somebody keeps what it said.
    """

    name: str
    what: str
    on: On
    lasts_s: float = LASTS_S
    world: str = 'clean'
    combines: bool = False
    spoils: bool = False


@dataclass(frozen=True)
class Command:
    """A hostile or implausible input to a command, which has to refuse it in one line.

    Attributes
    ----------
    name, what : str
        As for `Fault`.
    arguments : callable
        Makes the input in a folder and returns the arguments of `anser`.
    says : str
        A word that its answer has to have.
    """

    name: str
    what: str
    arguments: Callable[..., list[object]]
    says: str


def nothing() -> None:
    """Take nothing away: what a fault leaves when it has gone by itself."""
