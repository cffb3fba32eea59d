"""Reads the map of positions that is determined by the points from which it was learnt."""

import numpy as np

from anser_ros.calibration.position_map import PositionMap, Shape
from anser_ros.effects.effect import needed
from anser_ros.field.model import EffectRecord

SMOOTH = 'smooth'
"""The kind of such a map: it is determined by the points that it was learnt from."""


def smooth_map(record: EffectRecord) -> PositionMap:
    """Return the map of a record: what is added to tracked positions.

    Raises `EffectError` when a parameter is missing.
    """
    places, errors = (
        np.asarray(needed(record, key), dtype=np.float64).reshape(-1, 3)
        for key in ('places_m', 'errors_m')
    )
    values = [needed(record, key) for key in ('trend', 'length_m', 'noise')]
    shape = Shape(int(values[0]), float(values[1]), float(values[2]))
    return PositionMap(places, errors, shape)
