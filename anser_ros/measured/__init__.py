"""Importers of other people's measurements: each finds what its data contain and scores it.

The module of a data set has its ``NAME``, ``analyse(folder)``, ``rows(analysis)``, which returns
its `ReportRow` list, and ``tables(analysis)``, the text of all candidates. `cli/measured.py` lists
the data sets.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportRow:
    """One line of the table that `anser measured` prints.

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
    """

    dataset: str
    figure: str
    before: float
    after: float
    unit: str
    target: float | None
    met: bool | None
    chosen_on: str
