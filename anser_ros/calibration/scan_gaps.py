"""Finds what a scan leaves open of the field: the covariance of fitted moments, in a few modes.

A damped fit is the most probable one where moments differ from those that they are pulled to by
random amounts, as large as the damping implies. Its covariance is largest where no reading was:
it shows gaps beside places that were scanned, but is too small, for what a layout cannot represent
is not random. Blocks of space that were held out say by which factor.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites, basis_rows
from anser_ros.calibration.layout_fit import LayoutFit
from anser_ros.calibration.readings import frame_blocks
from anser_ros.field.gaps import ScanGaps
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import along_each_axis

Array = NDArray[np.float64]

GRID = (7, 7, 4)
"""Places along x, y and z of the scanned box at which the field's uncertainty is looked at."""
MARGIN_M = 0.01
"""Way beyond that box, m: a session goes about as far as its scan, not exactly."""
MOST_MODES = 24
"""Combinations of moments that are kept at most; each costs the model's file a number a dipole."""
LEAST_MODE_FLUX = 0.1
"""Largest flux of a mode at any place, relative to the flux noise, below which it is left out."""
DIGITS = 5
"""Digits after the first of the largest moment: an uncertainty needs no more, and the model's file
is shorter."""
FEWEST_HELD_OUT_FRAMES = 20
"""Held-out frames at least from which a factor is taken."""


def open_moments(fitted: LayoutFit, damping: float) -> Array:
    """Return a factor (N, N) of the moments' covariance, A m^2: a column for each mode."""
    fit, gram = fitted.fit, np.zeros((len(fitted.dipoles),) * 2)
    for part, weights in zip(fit.measurements, fit.weights, strict=True):
        for block in frame_blocks(*weights.shape):
            root = np.sqrt(weights[block].reshape(-1, 1))
            rows = root * basis_rows(part.frames(block), fitted.dipoles)
            gram += rows.T @ rows
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    size = np.sqrt(np.maximum(values, 0.0) + damping**2 * values[-1])
    return np.asarray(fit.noise_t * vectors / size / scale[:, None])


def expected_power(moments: Array, sites: DipoleSites, frames: Measurements) -> Array:
    """Return by how much frames may be off by what `open_moments` is of dipoles, (F,), T^2."""
    flux = basis_rows(frames, sites) @ moments
    return np.asarray((flux**2).sum(axis=1).reshape(len(frames.time), -1).mean(axis=1))


def factor_of(expected: Array, found: Array) -> float:
    """Return by which factor errors of held-out frames are larger than expected, at least one.

    ``expected``, ``found`` (F,): variances of a phasor component, T^2. The half of the frames with
    the larger expected ones counts: elsewhere what is found is noise.
    """
    if expected.size < FEWEST_HELD_OUT_FRAMES:
        return 1.0
    large = expected >= np.median(expected)
    return float(np.sqrt(max(np.median(found[large] / expected[large]), 1.0)))


def gaps_of(
    fitted: LayoutFit, damping: float, measurements: Sequence[Measurements], factor: float
) -> ScanGaps | None:
    """Return what a fit leaves open of the field in and about the volume that was scanned.

    ``fitted``: of the whole scan. ``factor``: by which errors are larger than the moments'
    covariance says (`factor_of`).
    Returns none where no place is uncertain by more than a share of the noise.
    """
    points = np.concatenate([m.placed()[0][m.usable] for m in measurements])
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    lines = [np.linspace(a, b, n) for a, b, n in zip(low, high, GRID, strict=True)]
    places = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 3)
    at, axes = along_each_axis(places)
    sites = fitted.dipoles
    basis = flux_basis(at, axes, np.zeros(len(axes)), sites.positions, sites.directions)
    root = factor * open_moments(fitted, damping)
    turned = root @ np.linalg.svd(basis @ root, full_matrices=False)[2][:MOST_MODES].T
    made = basis @ turned
    keep = np.abs(made).max(axis=0) > LEAST_MODE_FLUX * fitted.fit.noise_t
    if not keep.any():
        return None
    moments = turned.T[keep]
    decimals = DIGITS - int(np.floor(np.log10(np.abs(moments).max())))
    return ScanGaps(sites.positions, sites.directions, np.round(moments, decimals))
