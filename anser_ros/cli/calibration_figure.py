"""The figures of a calibration: what was tried for the field, and how the sensors differ."""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use('Agg')
from matplotlib import pyplot as plt

from anser_ros.calibration.result import Calibration


def draw_choice(calibration: Calibration, path: Path) -> None:
    """Draw held-out errors by the number of dipoles, and by damping for the six best layouts."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5.4), layout='constrained')
    for mark, name, chosen in (
        ('o', 'placed', lambda layout: not layout.moved),
        ('^', 'positions optimised', lambda layout: layout.moved),
    ):
        found = [c for c in calibration.candidates if chosen(c.layout)]
        left.plot(
            [len(c.dipoles) for c in found], [1e12 * c.score for c in found], mark, label=name
        )
    picked = calibration.chosen
    left.plot(len(picked.dipoles), 1e12 * picked.score, 's', ms=12, mfc='none', label='chosen')
    left.set(xlabel='dipoles', ylabel='predictive error of held-out blocks, pT', yscale='log')
    for candidate in sorted(calibration.candidates, key=lambda c: c.score)[:6]:
        damping, score = zip(*candidate.curve, strict=True)
        right.plot(damping, [1e12 * s for s in score], '.-', label=candidate.layout.describe())
    right.set(xlabel='damping', xscale='log', yscale='log')
    for panel in (left, right):
        panel.grid(alpha=0.3)
        # Below the axes, where it covers no curve.
        panel.legend(fontsize=7, loc='upper center', bbox_to_anchor=(0.5, -0.14))
    figure.suptitle('Choice by held-out error, pose marginalised', fontsize=10)
    figure.savefig(path, dpi=110, metadata={'Software': None})
    plt.close(figure)


def draw_populations(calibration: Calibration, path: Path) -> None:
    """Draw each channel's values with their uncertainty, and the population's width behind them.

    Nothing is drawn where the scan contains no population.
    """
    found = [e for e in calibration.scan.corrections if 'values' in e.parameters]
    if not found:
        return
    figure, panels = plt.subplots(1, len(found), figsize=(4 * len(found), 3.5), squeeze=False)
    for panel, effect in zip(panels[0], found, strict=True):
        values = np.array(effect.parameters['values'], dtype=np.float64)
        values = values - np.median(values, axis=0).round()
        sigma = np.array(effect.parameters['uncertainty'], dtype=np.float64)
        places, spread = np.arange(len(values)), float(effect.parameters['spread'])
        panel.axhspan(-spread, spread, color='0.9')
        for part in range(values.shape[1]):
            at = places + 0.15 * (part - (values.shape[1] - 1) / 2.0)
            panel.errorbar(at, values[:, part], sigma[:, part], fmt='.', capsize=2)
        panel.set_xticks(places, [str(c) for c in effect.parameters['channels']])
        panel.set(title=f'{effect.name}: {spread:.3g}', xlabel='channel')
        panel.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110, metadata={'Software': None})
    plt.close(figure)
