"""A block of points that drive each other: metal drawn from a class, to work out bounds with."""

from __future__ import annotations

from typing import Any

import numpy as np

from anser_ros.apps.lab.metal_lattice import Coils, Lattice, Setting, ball_answer, lattice_points
from anser_ros.field.model import FieldModel
from anser_ros.refit.clouds import Excitation

SPACING_M, GRID = 0.035, (7, 7, 3)
BALL = ball_answer(SPACING_M)
"""Answer of a conducting ball that fills a point's place, A m^2/T."""
SLOPE = 0.3
"""Part of an answer that changes with the logarithm of the frequency."""


def block_points() -> Any:
    """Places (n, 3) of the points, m, from the middle of the block's top."""
    points = lattice_points(GRID, SPACING_M)
    points[:, 2] -= points[:, 2].max() + SPACING_M / 2.0
    return points


class Block:
    """A lattice without slopes; those that an estimator has to reckon with are in `columns`.

    ``answer`` (n,), complex, is of each point, in units of `BALL`; ``tilt`` (K,) the logarithm of
    each emitter's frequency over their mean.
    """

    def __init__(self, answer: Any, tilt: Any) -> None:
        answer = np.asarray(answer, dtype=complex)
        self.lattice = Lattice(block_points(), BALL, answer, 0.0 * answer, 1.0)
        self.tilt = tilt

    @classmethod
    def drawn(cls, rng: np.random.Generator, tilt: Any) -> Block:
        """A body of the class: conducting, with losses."""
        n = len(block_points())
        return cls(-np.abs(rng.standard_normal(n)) + 0.3j * rng.standard_normal(n), tilt)

    def moments(self, place: Any, exc: Excitation) -> tuple[Any, Any]:
        """Points (n, 3), m, and their moments (K, n, 3), frame fg, in the emitters' phases."""
        placed = Setting(exc, self.tilt).placed(self.lattice, place)
        flat = self.lattice.moments(placed.driving, self.tilt)
        return placed.points, flat.reshape(len(flat), -1, 3) @ placed.turn.T

    def read(self, place: Any, exc: Excitation, at: Any, axes: Any, lengths: Any) -> Any:
        """Fluxes (S, K) in the emitters' phases."""
        setting = Setting(exc, self.tilt)
        placed = setting.placed(self.lattice, place)
        return setting.flux(self.lattice, placed, Coils(at, axes, lengths))

    def columns(self, place: Any, exc: Excitation, at: Any, axes: Any, lengths: Any) -> Any:
        """Derivatives (S K, 4n + 6) by answers, each of unit variance, and by place and turn."""
        setting, coils = Setting(exc, self.tilt), Coils(at, axes, lengths)
        by = setting.answer_columns(self.lattice, setting.placed(self.lattice, place), coils)
        by[:, :, by.shape[2] // 2 :] *= SLOPE
        both = np.concatenate([by, setting.pose_columns(self.lattice, place, coils)], axis=2)
        return both.reshape(-1, both.shape[2])

    def in_field(self, place: Any, exc: Excitation, model: FieldModel) -> FieldModel:
        """The model with the body's moments."""
        setting = Setting(exc, self.tilt)
        return setting.in_field(self.lattice, setting.placed(self.lattice, place), model)
