"""Reads the Navion files as arrays where they lie.

Boehler et al., IEEE T-RO 2022, doi 10.1109/TRO.2022.3197107, Apache-2.0.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured.navion_plate import PlateData
from anser_ros.measured.navion_states import split_states

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NavionData:
    """Holds the steady readings and what belongs to them.

    Attributes
    ----------
    plane : tuple of int
        The data set's own numbers of the heights.
    coils : PlateData
        The coil terms of the eight states: the field of one coil at its full current, T.
    terms_t : ndarray, shape (P, 8, S, 3)
        All terms of the eight states (constant, coils, pairs, triple), T.
    sign : ndarray, shape (8, 3)
        Signs of the three currents in the eight states.
    zero_t : ndarray, shape (P, S, 3)
        The state without current as the data set stores it, T.
    """

    plane: tuple[int, ...]
    coils: PlateData
    terms_t: Array
    sign: Array
    zero_t: Array


def load(folder: Path) -> NavionData:
    """Read ``navion_steady.csv``; positions m, currents A and fields mT as its header says.

    Raises
    ------
    FitError
        When the file is missing, or lacks a state of a sensor.
    """
    path = folder / 'navion_steady.csv'
    if not path.is_file():
        raise FitError(f'no such file: {path}')
    with path.open(newline='') as stream:
        rows = list(csv.DictReader(stream))
    number = np.array([[float(value) for value in row.values()] for row in rows])
    column = {name: k for k, name in enumerate(rows[0])}

    def take(*names: str) -> Array:
        return number[:, [column[name] for name in names]]

    plane, state = take('plane')[:, 0], take('state')[:, 0]
    planes = np.unique(plane)
    order = np.lexsort((take('sensor')[:, 0], state, plane))
    n_sensors = len(np.unique(take('sensor')[:, 0]))
    shape = (len(planes), len(np.unique(state)), n_sensors)
    if len(rows) != math.prod(shape):
        raise FitError(f'{path.name}: {len(rows)} rows, expected {math.prod(shape)}')
    current = take('I0_A', 'I1_A', 'I2_A')[order].reshape(*shape, 3)[0, :, 0]
    field = take('Bx_mT', 'By_mT', 'Bz_mT')[order].reshape(*shape, 3) * 1e-3
    place = take('x_m', 'y_m', 'z_m')[order].reshape(*shape, 3)[:, 0]
    driven = np.abs(current).min(axis=1) > 0.0
    sign = np.sign(current[driven])
    terms = np.array([split_states(reading, sign) for reading in field[:, driven]])
    grid = place[0] * np.array([1.0, 1.0, 0.0])
    return NavionData(
        plane=tuple(int(p) for p in planes),
        coils=PlateData(place[:, 0, 2], grid, terms[:, 1:4]),
        terms_t=terms,
        sign=sign,
        zero_t=field[:, ~driven][:, 0],
    )


def inner(data: NavionData) -> list[int]:
    """Return the heights that have others above and below, which interpolation predicts."""
    height = data.coils.height_m
    return [p for p, h in enumerate(height) if height.min() < h < height.max()]
