"""A board as a workshop builds it: a little off the drawing that the setup document holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from anser_ros.wire.setup import Setup

SHIFT_M = 0.2e-3
TURN_DEG = 0.1
CURRENT_SHARE = 0.01


def manufactured(setup: Setup, rng: np.random.Generator) -> Setup:
    """The setup with its coils a little off and its current a little too strong.

    The drawing does not know of it, so the nominal model is wrong for such a board.
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
