"""Fits the emitters' own field where no tool sensor ever was: beside the board and below it.

A calibrated model is only as good as its data: it may be any field at the places of metal and of
reference sensors. Currents in a board make a sheet of vertical dipoles in its plane, so such a
sheet is fitted to the model inside the volume and to the references' clean readings, starting from
the drawn board where the setup draws one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import field_basis, flux_basis
from anser_ros.physics.sensor import SensorTable
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

VOLUME_ERROR = 1e-3
"""Relative error that the fit allows the model in the volume, a quarter of a reference's
(`reference_gain`): calibrated models are better than that."""
LEAST_ERROR = 1e-5
"""Relative error that references are given at least, so that exact ones do not divide by zero."""
DRAWING_ERROR = 0.05
"""Prior spread of the sheet's moments about the drawn ones, as a share of their rms: a coil's
moment is off by 2 % (`nominal.Tolerances`), and half a millimetre moves a few percent of it."""


class CleanReferences(NamedTuple):
    """Holds reference sensors, their clean readings, (R, K), T, and their relative gain error."""

    sensors: SensorTable
    flux: ComplexArray
    gain_error: float = Accuracy.reference_gain


def board_box(model: FieldModel) -> Array:
    """Return the two corners of the model's dipoles that carry the field, shape (2, 3), m."""
    strength = np.abs(model.moments).max(axis=1)
    used = model.positions[strength > 1e-3 * strength.max()]
    return np.stack([used.min(axis=0), used.max(axis=0)])


def fit_illumination(
    model: FieldModel,
    drawn: FieldModel | None,
    points: Array,
    references: CleanReferences | None,
) -> Dipoles:
    """Return a sheet of dipoles that is good in the volume, at the references and below the board.

    ``model``: trusted at ``points``; ``drawn``: the nominal model of the setup's geometry; None
    where it has none, and the model itself is all that there is; ``points`` (P, 3): some places in
    the volume, m.
    """
    if drawn is None:
        return Dipoles(model.positions, model.directions, model.moments)
    place, direction = drawn.positions, drawn.directions
    basis = field_basis(points, place, direction).transpose(0, 2, 1).reshape(-1, len(place))
    wanted = Dipoles(model.positions, model.directions, model.moments).field(points)
    wanted = wanted.reshape(-1, wanted.shape[2])
    start = drawn.moments * _gains(basis @ drawn.moments, wanted)
    scale = VOLUME_ERROR * np.sqrt(np.mean(np.abs(wanted) ** 2))
    rows, values = [basis / scale], [(wanted - basis @ start) / scale]
    if references is not None:
        good = np.isfinite(references.flux).all(axis=1)
        s = references.sensors.select(np.flatnonzero(good))
        sheet = flux_basis(s.position, s.axis, s.length, place, direction)
        clean = references.flux[good]
        weight = max(references.gain_error, LEAST_ERROR) * np.sqrt(np.mean(np.abs(clean) ** 2))
        rows.append(sheet / weight)
        values.append((clean - sheet @ start) / weight)
    spread = DRAWING_ERROR * np.sqrt(np.mean(np.abs(start) ** 2))
    matrix, target = np.concatenate(rows) * spread, np.concatenate(values)
    normal = matrix.T @ matrix + np.eye(len(place))
    change = np.linalg.solve(normal, matrix.T @ target) * spread
    return Dipoles(place, direction, start + change)


def _gains(drawn: ComplexArray, wanted: ComplexArray) -> ComplexArray:
    """Complex gain of each emitter that brings the drawn field nearest to the wanted one."""
    power = np.sum(np.abs(drawn) ** 2, axis=0)
    return np.asarray(np.sum(drawn.conj() * wanted, axis=0) / np.where(power > 0, power, 1.0))
