"""Simulates a board with the errors of its manufacture, slightly different from its drawing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from anser_ros.wire.setup import Setup

SHIFT_M = 0.2e-3
"""Standard deviation of a coil's position along each axis, m: an assumption about printed boards,
smaller than the tolerances of the nominal model (0.5 mm)."""
TURN_DEG = 0.1
"""Standard deviation of a coil's rotation about z, degrees, an assumption as well."""
CURRENT_SHARE = 0.01
"""Fraction by which all currents are too large, half of the nominal model's tolerance of gains."""


def manufactured(setup: Setup, rng: np.random.Generator) -> Setup:
    """Return a setup with random errors of its coils' places and a slightly too large current.

    The setup document keeps the drawing, so that the nominal model is wrong for such a board.
    """
    coils = tuple(
        replace(
            coil,
            centre_m=tuple(np.array(coil.centre_m) + rng.normal(scale=SHIFT_M, size=3)),
            rotation_deg=coil.rotation_deg + float(rng.normal(scale=TURN_DEG)),
        )
        for coil in setup.emitter.coils
    )
    geometry = dict(setup.emitter.geometry)
    geometry['current_a'] = float(geometry.get('current_a', 1.0)) * (1 + CURRENT_SHARE)
    return replace(setup, emitter=replace(setup.emitter, coils=coils, geometry=geometry))
