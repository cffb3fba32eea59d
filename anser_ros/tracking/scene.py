"""A field model made ready for tracking: kernel layout, error model, cold-start grid."""

import hashlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.fitting.model import FieldModel
from anser_ros.physics.dipole import flux_basis
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.seed import SeedGrid, Volume, build_grid
from anser_ros.tracking.solve import RealField

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BOX_MARGIN_M = 0.1
"""How far beyond the volume the solver may go, so that a tool there is said to be there."""
GRID_TOLERANCE = 0.05
"""Relative change of the field up to which a grid may go on serving as a source of starts."""


@dataclass(frozen=True)
class Scene:
    """What every solve of a frame shares.

    Attributes
    ----------
    field : RealField
    sigma : ndarray, shape (2K,)
        Noise and the model's own unexplained part, T.
    modes : ndarray, shape (N, R 2K), or None
        The moments' covariance factor, laid out for one product with a sensor's basis.
    given_modes : ndarray, shape (R, N, K), or None
        The model's own array that ``modes`` was made from: a model that has the same array has the
        same modes, and all that sensors derived from them stays good.
    relative_error : float
        Typical model error by ``modes`` over the field's strength.
    grid : SeedGrid
    landmarks : ndarray
        The field at a few points of the volume when the grid was built, T.
    low, high : ndarray, shape (3,)
        Box of the solver, m.
    model_id : str
    """

    field: RealField
    sigma: Array
    modes: Array | None
    given_modes: ComplexArray | None
    relative_error: float
    grid: SeedGrid
    landmarks: Array
    low: Array
    high: Array
    model_id: str

    def error_modes(self, points: Array, axes: Array, lengths: Array) -> Array | None:
        """Flux errors of one sigma each at given sensors, shape (R, S, 2K), T, or None."""
        if self.modes is None:
            return None
        basis = flux_basis(points, axes, lengths, self.field.positions, self.field.directions)
        flux = basis @ self.modes
        return np.ascontiguousarray(flux.reshape(len(points), -1, self.sigma.size).swapaxes(0, 1))


def model_digest(model: FieldModel) -> str:
    """Eight hexadecimal digits that tell models apart."""
    digest = hashlib.blake2b(digest_size=4)
    for array in (model.positions, model.directions, model.moments):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _landmark_basis(volume: Volume, field: RealField) -> Array:
    sides = [
        np.linspace(a + 0.15 * (b - a), b - 0.15 * (b - a), 3)
        for a, b in zip(volume.low, volume.high, strict=True)
    ]
    points = np.stack([side.ravel() for side in np.meshgrid(*sides, indexing='ij')], axis=1)
    count = len(points)
    return flux_basis(
        np.repeat(points, 3, axis=0), np.tile(np.eye(3), (count, 1)), None,
        field.positions, field.directions,
    )  # fmt: skip


def _same_modes(model: FieldModel, previous: Scene) -> bool:
    return (
        model.modes is previous.given_modes
        and model.modes is not None
        and len(model.positions) == len(previous.field.positions)
    )


def build_scene(
    model: FieldModel,
    settings: TrackerSettings,
    previous: Scene | None = None,
    model_id: str | None = None,
) -> Scene:
    """Make a model ready; a grid of a model that is nearly the same is kept.

    Raises
    ------
    TrackingError
        When the model's arrays can't be used.
    """
    field = RealField.of(model.positions, model.directions, model.moments)
    width = field.moments.shape[1]
    variance = settings.flux_noise_t**2 + float(model.flux_error_t) ** 2
    sigma = np.full(width, math.sqrt(variance))
    modes = None
    basis = _landmark_basis(settings.volume, field)
    landmarks = basis @ field.moments
    relative = 0.0
    if previous is not None and previous.modes is not None and _same_modes(model, previous):
        modes, relative = previous.modes, previous.relative_error
    elif model.modes is not None and len(model.modes):
        real = np.ascontiguousarray(model.modes, dtype=np.complex128).view(np.float64)
        modes = np.ascontiguousarray(real.swapaxes(0, 1).reshape(len(real[0]), -1))
        error = (basis @ modes).reshape(len(basis), -1, width)
        power = (error**2).sum(axis=1).mean(axis=1) / (landmarks**2).mean(axis=1)
        relative = float(np.sqrt(np.median(power)))
    low, high = settings.volume.grown(BOX_MARGIN_M)
    grid = None
    if previous is not None and previous.landmarks.shape == landmarks.shape:
        change = np.linalg.norm(landmarks - previous.landmarks, axis=1)
        if (change <= GRID_TOLERANCE * np.linalg.norm(previous.landmarks, axis=1)).all():
            grid, landmarks = previous.grid, previous.landmarks
    if grid is None:
        grid = build_grid(field, sigma, settings.volume, settings.grid_spacing_m)
    return Scene(
        field, sigma, modes, model.modes, relative, grid, landmarks, low, high,
        model_digest(model) if model_id is None else model_id,
    )  # fmt: skip
