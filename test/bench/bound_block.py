"""A block of points that drive each other: metal drawn from a class, to work out bounds with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import DIPOLE_CONSTANT, MU_0
from anser_ros.refit.excitation import Excitation
from anser_ros.refit.references import vector_basis

SPACING_M, GRID = 0.035, (7, 7, 3)
BALL = 2.0 * np.pi * (SPACING_M / 2.0) ** 3 / MU_0
"""Answer of a conducting ball that fills a point's place, A m^2/T."""
SLOPE = 0.3
"""Part of an answer that changes with the logarithm of the frequency."""
STEP = np.array([1e-3] * 3 + [5e-3] * 3)
"""Of the numerical derivative by place and turn, m and rad."""


def block_points() -> Any:
    """Places (n, 3) of the points, m, from the middle of the block's top."""
    sides = [SPACING_M * (np.arange(n) - (n - 1) / 2.0) for n in GRID]
    sides[2] = sides[2] - sides[2].max() - SPACING_M / 2.0
    return np.stack(np.meshgrid(*sides, indexing='ij'), -1).reshape(-1, 3)


class Block:
    """Points that drive each other: moments m = (1 - A G)^-1 A b of the driving fields b.

    Parameters
    ----------
    answer : ndarray, shape (n,), complex
        Of each point, in units of `BALL`.
    tilt : ndarray, shape (K,)
        Logarithm of each emitter's frequency over their mean.
    """

    def __init__(self, answer: Any, tilt: Any) -> None:
        self.points, self.tilt = block_points(), tilt
        n = len(self.points)
        gap = self.points[:, None] - self.points + np.eye(n)[:, :, None]
        far2 = (gap**2).sum(axis=2)[..., None, None]
        along = gap[..., :, None] * gap[..., None, :]
        mutual = DIPOLE_CONSTANT * (3.0 * along / far2 - np.eye(3)) / far2**1.5
        mutual[np.arange(n), np.arange(n)] = 0.0
        mutual = mutual.swapaxes(1, 2).reshape(3 * n, 3 * n)
        alone = np.repeat(BALL * answer, 3)
        self.out = np.linalg.inv(np.eye(3 * n) - alone[:, None] * mutual)
        self.response = self.out * alone
        self.into = np.eye(3 * n) + mutual @ self.response

    @classmethod
    def drawn(cls, rng: np.random.Generator, tilt: Any) -> Block:
        """A body of the class: conducting, with losses."""
        n = len(block_points())
        return cls(-np.abs(rng.standard_normal(n)) + 0.3j * rng.standard_normal(n), tilt)

    def placed(self, place: Any, exc: Excitation) -> tuple[Any, Any, Any]:
        """Points (n, 3), rotation, and driving fields (K, 3n) in the body's axes."""
        turn = Rotation.from_rotvec(place[3:]).as_matrix()
        points = place[:3] + self.points @ turn.T
        driving = exc.field(points) @ turn
        return points, turn, driving.swapaxes(0, 1).reshape(driving.shape[1], -1)

    def read(self, place: Any, exc: Excitation, at: Any, axes: Any, lengths: Any) -> Any:
        """Fluxes (S, K) in the emitters' phases."""
        points, turn, driving = self.placed(place, exc)
        basis = (vector_basis(at, axes, lengths, points) @ turn).reshape(len(at), -1)
        return basis @ (driving @ self.response.T).T

    def columns(self, place: Any, exc: Excitation, at: Any, axes: Any, lengths: Any) -> Any:
        """Derivatives (S K, 4n + 6) by answers, each of unit variance, and by place and turn."""
        points, turn, driving = self.placed(place, exc)
        basis = (vector_basis(at, axes, lengths, points) @ turn).reshape(len(at), -1)
        heard = (basis @ self.out).reshape(len(at), -1, 3)
        felt = (driving @ self.into.T).reshape(len(driving), -1, 3)
        by = BALL * np.einsum('snj,knj->skn', heard, felt, optimize=True)
        tilted = SLOPE * self.tilt[None, :, None] * by
        moved = []
        for i, step in enumerate(STEP):
            unit = step * np.eye(6)[i]
            ahead = self.read(place + unit, exc, at, axes, lengths)
            behind = self.read(place - unit, exc, at, axes, lengths)
            moved.append((ahead - behind) / (2.0 * step))
        both = np.concatenate([by, 1j * by, tilted, 1j * tilted, np.stack(moved, -1)], axis=2)
        return both.reshape(-1, both.shape[2])

    def in_field(self, place: Any, exc: Excitation, model: FieldModel) -> FieldModel:
        """The model with the body's moments."""
        points, turn, driving = self.placed(place, exc)
        moments = (driving @ self.response.T).reshape(len(driving), -1, 3) @ turn.T
        moments = (moments * exc.phase[:, None, None]).transpose(1, 2, 0)
        directions = np.tile(np.eye(3), (len(points), 1))
        flat = np.ascontiguousarray(moments.reshape(len(directions), -1))
        return replace(model, modes=None).with_dipoles(
            np.repeat(points, 3, axis=0), directions, flat
        )
