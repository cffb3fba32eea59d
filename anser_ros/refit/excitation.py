"""Computes the emitters' field below and around the board, which drives the metal there.

A calibrated model is fitted where tools are, over the board. Extrapolated below the board it is
wrong by tens of percent near the coils, while the coils' drawing gives that field to a percent. So
the drawing is used if there is one, with strength and phase taken from the calibrated model.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import field_basis
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.clouds import Region

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
FieldFunction = Callable[[Array], Array]
"""Field of each emitter at its nominal current: points (P, 3), m, to (P, K, 3), T."""

AGREEMENT = 0.9
"""Correlation with the calibrated model below which a drawing is not of this board."""
SEARCH_M = 1.0
"""Half size of the square in which the board is searched, m."""
SEARCH_POINTS = 61
"""Points along a side of that search, about 3 cm apart: less than a coil of a board is wide."""
SEARCH_HEIGHT_M = 0.02
"""Height over the board at which its field is compared, m."""


@dataclass(frozen=True)
class Excitation:
    """Gives the driving field, in phase with the current of each emitter.

    Attributes
    ----------
    source : {'board', 'model'}
        Where it comes from.
    phase : ndarray, shape (K,), complex
        Unit phasor of each emitter's field; readings are turned back by it.
    field : callable
        From points (P, 3), m, to the field there, (P, K, 3), T.
    """

    source: str
    phase: ComplexArray
    field: FieldFunction


def model_field(model: FieldModel, points: Array) -> ComplexArray:
    """Return the field of a model's emitters, shape (P, K, 3), T."""
    basis = field_basis(points, model.positions, model.directions)
    return np.asarray(np.einsum('pna,nk->pka', basis, model.moments, optimize=True))


def region_of(field: Callable[[Array], NDArray[np.generic]]) -> Region:
    """Return the board's extent: the square with 98 % of its field's power over the surface.

    Raises
    ------
    FitError
        When the field is zero or not finite.
    """
    side = np.linspace(-SEARCH_M, SEARCH_M, SEARCH_POINTS)
    x, y = np.meshgrid(side, side, indexing='ij')
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, SEARCH_HEIGHT_M)], axis=1)
    values = np.abs(field(points)) ** 2
    power = (values / np.maximum(values.sum(axis=(0, 2)), 1e-300)[None, :, None]).sum(axis=(1, 2))
    power = power.reshape(x.shape)
    if not np.isfinite(power).all() or power.sum() <= 0.0:
        raise FitError('refit: the emitters make no field over the board')
    edges = []
    for axis in range(2):
        line = power.sum(axis=1 - axis)
        share = (np.cumsum(line) - 0.5 * line) / line.sum()
        edges.append([np.interp(level, share, side) for level in (0.01, 0.99)])
    low, high = np.array(edges).T
    return Region((low + high) / 2.0, float((high - low).max() / 2.0))


def excitation_for(
    model: FieldModel, drawing: FieldFunction | None, volume: TrackedVolume | None = None
) -> tuple[Excitation, Region]:
    """Return the drawing's field scaled to the model, or the model's if the drawing is another's.

    ``volume`` is the tracked volume as stated; None for the default over the board.

    Raises
    ------
    FitError
        When the drawing has another number of emitters than the model.
    """

    def own(points: Array) -> ComplexArray:
        return model_field(model, points)

    region = replace(region_of(own if drawing is None else drawing), stated=volume)
    points = region.volume.samples()
    high = points[:, 2] > 0.6 * region.half
    points = points[high] if high.any() else points
    measured = own(points)
    if drawing is not None:
        drawn = drawing(points)
        if drawn.shape != measured.shape:
            raise FitError(
                f'refit: the drawing makes fields {drawn.shape}, the model {measured.shape}'
            )
        power = (drawn**2).sum(axis=(0, 2))
        gain = (drawn * measured).sum(axis=(0, 2)) / np.maximum(power, 1e-300)
        size = np.sqrt(power * (np.abs(measured) ** 2).sum(axis=(0, 2)))
        if (np.abs(gain) * power >= AGREEMENT * size).all():
            strength = np.abs(gain)

            def scaled(points: Array) -> Array:
                return np.asarray(drawing(points) * strength[None, :, None])

            return Excitation('board', gain / strength, scaled), region
        region = replace(region_of(own), stated=volume)
    square = (measured**2).sum(axis=(0, 2))
    phase = np.exp(0.5j * np.angle(square))

    def turned(points: Array) -> Array:
        return np.asarray((own(points) * phase.conj()[None, :, None]).real)

    return Excitation('model', phase, turned), region
