"""Offers the field model to scripts: load, save, predict."""

import os
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from anser_ros.api.recording import SetupSource, load_setup
from anser_ros.arrays import numbers_of
from anser_ros.errors import ParameterError
from anser_ros.field.model import FARTHEST_M, FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.sessions.nominal_board import board_of
from anser_ros.sessions.starting_model import load_model, save_model
from anser_ros.wire.setup import Setup
from anser_ros.wire.setup_values import AXIS_TOLERANCE
from anser_ros.wire.text_files import NOMINAL, path_of


@dataclass(frozen=True)
class Model:
    """Predicts the field of every emitter, with its uncertainty and known effects.

    Attributes
    ----------
    field : FieldModel
        The dipoles that make the field, their moments and the effects that the model corrects.
        Called with points (..., 3), m, in fg it returns each emitter's field there, (..., 3, K),
        T at nominal current.

    Examples
    --------
    >>> from anser_ros import Model
    >>> model = Model.load('config/demo_model.yaml')
    >>> model.emitters[:2], model.frequencies_hz[:2]
    (('coil0', 'coil1'), (6000.0, 6170.0))
    >>> flux = model.flux([[0.0, 0.0, 0.15]], [[0.0, 0.0, 1.0]])
    >>> flux.shape, flux.dtype
    ((1, 8), dtype('complex128'))
    >>> model.field([[0.0, 0.0, 0.15], [0.0, 0.0, 0.2]]).shape
    (2, 3, 8)
    """

    field: FieldModel

    def __repr__(self) -> str:
        effects = f', effects: {", ".join(self.effects)}' if self.effects else ''
        count = len(self.field.positions)
        return f'Model({count} dipoles of {len(self.emitters)} emitters{effects})'

    @classmethod
    def load(cls, path: 'ModelSource') -> Self:
        """Read a model file; a model is returned as it is.

        Raises
        ------
        ModelFileError
            When the file is no model.
        ParameterError
            When what is given is neither a path nor a model.
        """
        if isinstance(path, Model):
            return cls(path.field)
        if isinstance(path, FieldModel):
            return cls(path)
        if path == NOMINAL:
            raise ParameterError('nominal is of a setup: give Model.nominal(setup)')
        return cls(load_model(path_of(path, 'a model')))

    @classmethod
    def nominal(cls, setup: SetupSource) -> Self:
        """Make the nominal model of a board: the Biot-Savart field of its stated geometry.

        Raises
        ------
        SetupError
            When the setup breaks a rule, or its emitter kind is not one of known geometry.

        Examples
        --------
        >>> from pathlib import Path
        >>> from anser_ros import Model
        >>> len(Model.nominal(Path('config/demo_setup.yaml')).emitters)
        8
        """
        return cls(nominal_model(board_of(load_setup(setup))))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model file that every command and node loads; raises `ModelFileError`."""
        save_model(path_of(path, 'a file to write'), self.field)

    @property
    def emitters(self) -> tuple[str, ...]:
        """Return the names of the K emitters, in the order of the flux columns."""
        return self.field.emitters

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Return the drive frequencies of the emitters, Hz."""
        return self.field.frequencies_hz

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the names of the effects that the model corrects."""
        return tuple(effect.name for effect in self.field.effects)

    def flux(self, position: ArrayLike, axis: ArrayLike) -> NDArray[np.complex128]:
        """Predict the flux of point coils.

        Parameters
        ----------
        position : array_like, shape (..., 3)
            Centres of the coils in fg, m.
        axis : array_like, shape (..., 3)
            Their sensitive axes in fg, unit vectors.

        Returns
        -------
        ndarray, shape (..., K), complex
            Flux density along the axis, T at each emitter's nominal current.

        Raises
        ------
        ParameterError
            When the two shapes differ, or do not end in 3, a position is not finite or not in m,
            or an axis is not a unit vector.
        """
        points, axes = numbers_of(position, 'positions', 3, FARTHEST_M), numbers_of(axis, 'axes')
        if points.shape != axes.shape:
            raise ParameterError(
                f'positions and axes must both be (..., 3), got {points.shape} and {axes.shape}'
            )
        length = np.linalg.norm(axes, axis=-1)
        if not (np.abs(length - 1.0) <= AXIS_TOLERANCE).all():
            raise ParameterError(f'axes must be unit vectors, got length {length.max():.4g}')
        return self.field.flux(points, axes)


ModelSource = Model | FieldModel | str | os.PathLike[str]


def field_given(given: ModelSource, setup: Setup) -> FieldModel:
    """Return a model's field; ``nominal`` is that of the board as a setup draws it."""
    is_drawn = isinstance(given, str) and given == NOMINAL
    return (Model.nominal(setup) if is_drawn else Model.load(given)).field
