"""Draws a calibration: what was tried for the field."""

from dataclasses import replace
from typing import TYPE_CHECKING

from anser_ros.calibration.result import Calibration
from anser_ros.cli.diagnosis_words import flux_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def choice_figure(calibration: Calibration) -> 'Figure | None':
    """Draw held-out errors by the number of dipoles, and by damping for the six best layouts.

    Returns None where no layouts were compared.
    """
    if not calibration.candidates:
        return None
    from matplotlib import pyplot as plt

    from anser_ros.cli.html_page import legend_under

    layout = replace(calibration.layout, local=False)
    picked = next(one for one in calibration.candidates if one.layout == layout)
    factor, unit = flux_unit(picked.score)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5.4), layout='constrained')
    for mark, name, moved in (('o', 'placed', False), ('^', 'positions optimised', True)):
        found = [c for c in calibration.candidates if bool(c.layout.moved) == moved]
        scores = [factor * c.score for c in found]
        left.plot([len(c.dipoles) for c in found], scores, mark, label=name)
    left.plot(len(picked.dipoles), factor * picked.score, 's', ms=12, mfc='none', label='chosen')
    left.set(xlabel='dipoles', ylabel=f'predictive error of held-out blocks, {unit}', yscale='log')
    for candidate in sorted(calibration.candidates, key=lambda c: c.score)[:6]:
        damping, score = zip(*candidate.curve, strict=True)
        right.plot(damping, [factor * s for s in score], '.-', label=candidate.layout.describe())
    right.set(xlabel='damping', xscale='log', yscale='log')
    for panel in (left, right):
        panel.grid(alpha=0.3)
        legend_under(panel, 0.14, 7, columns=1)
    figure.suptitle('Choice by held-out error, pose marginalised', fontsize=10)
    return figure
