"""Imports other people's measurements, with recipes of commands that find what is in them.

A data set has a ``RECIPE`` (`recipe.Recipe`): its sessions, the commands that are run on them, and
the figures that these give. `cli/measured.py` lists the data sets.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportRow:
    """Holds one line of the table that `anser measured` prints.

    Attributes
    ----------
    dataset : str
        Folder of the measurement.
    figure : str
        What is measured, in words.
    before, after : float
        The figure without and with the effects that were found; nan where there is none.
    unit : str
        Unit of `before`, `after` and `target`.
    target : float or None
        What `after` should not exceed (for a correlation: not fall below).
    met : bool or None
        Whether it does; None without a target.
    chosen_on : str
        What the effects were chosen and fitted on, and what the figure was scored on.
    special : float or None
        `after` of code that was written for this data set alone, where a recipe has taken its
        place: see docs/results/README.md.
    """

    dataset: str
    figure: str
    before: float
    after: float
    unit: str
    target: float | None
    met: bool | None
    chosen_on: str
    special: float | None = None
