"""Keeps in a model's file what reference sensors read without metal when it was calibrated."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ModelFileError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class ReferenceReadings:
    """Holds mean readings of the reference sensors while nothing distorted the field."""

    name: tuple[str, ...]  # length R
    # (R, 3), surveyed places, m, frame fg: a sensor that is elsewhere now reads something else
    position: Array
    axis: Array  # (R, 3), surveyed unit axes
    flux: ComplexArray  # (R, K), T
    sigma_t: float  # Noise of a component of these means, T


def readings_document(readings: ReferenceReadings) -> dict[str, Any]:
    """Return readings as plain lists and mappings, a row per sensor."""
    parts = np.stack([readings.flux.real, readings.flux.imag], axis=2).reshape(
        len(readings.name), -1
    )
    rows = np.concatenate([readings.position, readings.axis, parts], axis=1)
    return {
        'sigma_t': readings.sigma_t,
        'sensors': [
            {'name': name, 'row': row}
            for name, row in zip(readings.name, rows.tolist(), strict=True)
        ],
    }


def parse_readings(document: Any, emitters: int) -> ReferenceReadings:
    """Return what `readings_document` wrote; raises `ModelFileError` with the rule it breaks."""
    try:
        sensors = document['sensors']
        names = tuple(str(item['name']) for item in sensors)
        rows = np.array([item['row'] for item in sensors], dtype=np.float64)
        sigma = float(document['sigma_t'])
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f'model: references are malformed: {error}') from error
    if rows.shape != (len(names), 6 + 2 * emitters) or not names:
        raise ModelFileError(
            f'model: references must be rows of {6 + 2 * emitters} numbers, got {rows.shape}'
        )
    if not (np.isfinite(rows).all() and 0.0 <= sigma < np.inf):
        raise ModelFileError('model: references hold values that are not finite')
    flux = np.ascontiguousarray(rows[:, 6::2] + 1j * rows[:, 7::2])
    return ReferenceReadings(names, rows[:, :3].copy(), rows[:, 3:6].copy(), flux, sigma)
