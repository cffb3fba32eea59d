"""Draws a calibration: what was tried for the field, and how the sensors differ."""

from dataclasses import replace
from pathlib import Path

from anser_ros.calibration.result import Calibration
from anser_ros.cli.diagnosis_words import flux_unit
from anser_ros.cli.populations import population_figure


def draw_choice(calibration: Calibration, path: Path) -> None:
    """Draw held-out errors by the number of dipoles, and by damping for the six best layouts;
    nothing is drawn where no layouts were compared.
    """
    if not calibration.candidates:
        return
    from matplotlib import pyplot as plt

    from anser_ros.pictures import save

    layout = replace(calibration.layout, local=False)
    picked = next(one for one in calibration.candidates if one.layout == layout)
    factor, unit = flux_unit(picked.score)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5.4), layout='constrained')
    for mark, name, chosen in (
        ('o', 'placed', lambda layout: not layout.moved),
        ('^', 'positions optimised', lambda layout: layout.moved),
    ):
        found = [c for c in calibration.candidates if chosen(c.layout)]
        left.plot(
            [len(c.dipoles) for c in found], [factor * c.score for c in found], mark, label=name
        )
    left.plot(len(picked.dipoles), factor * picked.score, 's', ms=12, mfc='none', label='chosen')
    left.set(xlabel='dipoles', ylabel=f'predictive error of held-out blocks, {unit}', yscale='log')
    for candidate in sorted(calibration.candidates, key=lambda c: c.score)[:6]:
        damping, score = zip(*candidate.curve, strict=True)
        right.plot(damping, [factor * s for s in score], '.-', label=candidate.layout.describe())
    right.set(xlabel='damping', xscale='log', yscale='log')
    for panel in (left, right):
        panel.grid(alpha=0.3)
        # Below the axes, where it covers no curve.
        panel.legend(fontsize=7, loc='upper center', bbox_to_anchor=(0.5, -0.14))
    figure.suptitle('Choice by held-out error, pose marginalised', fontsize=10)
    save(figure, path)


def draw_populations(calibration: Calibration, path: Path) -> None:
    """Draw how the sensors differ; nothing is drawn where the scan contains no population."""
    figure = population_figure(calibration.scan.corrections)
    if figure is not None:
        from anser_ros.pictures import save

        save(figure, path)
