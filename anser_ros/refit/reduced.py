"""Reduces a hypothesis' metal to few numbers: the directions that affect poses.

The field of a cloud's thousands of sources, as the layer makes it in the tracked volume, has some
tens of directions that affect poses. Coordinates along them have unit variance for metal of unit
strength, so a posterior over metal is a mean and a small covariance matrix, which readings of
coils that move can update frame by frame. The directions are those of a randomised singular value
decomposition (Halko, Martinsson & Tropp, SIAM Review 53 (2011) 217).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.prior import CloudPrior, frequency_tilt

Array = NDArray[np.float64]
Single = NDArray[np.float32]

DIRECTIONS = 64
"""Directions that are kept. What more would add, poses feel a thousandth of."""
OVERSAMPLED = 12
"""Further directions that are searched in, without which the last ones kept are poor."""
AT_ONCE = 400
"""Sources worked out at once: their columns are some tens of megabytes."""


@dataclass(frozen=True)
class ReducedPrior:
    """Holds the coordinates of a hypothesis.

    Attributes
    ----------
    basis : ndarray, shape (N, K D), single precision
        Moments of the layer by unit coordinates; metal of strength a has coordinates of variance
        a, independent of each other.
    cross : ndarray, shape (D, S K)
        Covariance of the coordinates with all readings of the references.
    felt : ndarray, shape (D,)
        What poses feel of unit coordinates (`Layer.metric`); no two feel alike.
    """

    basis: Single
    cross: Array
    felt: Array


def reduced(
    prior: CloudPrior, excitation: Array, frequencies_hz: Array, rng: np.random.Generator
) -> ReducedPrior:
    """Return the coordinates of a hypothesis.

    ``excitation`` (M, K, 3): field of the emitters at its sources, T. ``rng``: for the search of
    the directions.
    """
    layer, k = prior.layer, excitation.shape[1]
    n = len(layer.positions)

    def felt(moments: Array) -> Array:
        """What poses feel of moments (N K, R)."""
        return np.asarray((layer.metric @ moments.reshape(n, -1)).reshape(moments.shape))

    wanted = DIRECTIONS + OVERSAMPLED
    sketch = np.zeros((n * k, wanted))
    for part in _columns(prior, excitation, frequencies_hz):
        sketch += part @ rng.standard_normal((part.shape[1], wanted)).astype(np.float32)
    frame, _ = np.linalg.qr(felt(sketch))
    # Transposed metric: rows of the layer, emitter by emitter.
    seen = (layer.metric.T @ frame.reshape(n, -1)).reshape(n * k, -1)
    moments = np.zeros((n * k, frame.shape[1]))
    small = seen.astype(np.float32)
    for part in _columns(prior, excitation, frequencies_hz):
        moments += part @ (part.T @ small)
    values, vectors = np.linalg.eigh(frame.T @ felt(moments))
    values, vectors = values[::-1][:DIRECTIONS], vectors[:, ::-1][:, :DIRECTIONS]
    keep = values > 1e-12 * values[0]
    root, vectors = np.sqrt(values[keep]), vectors[:, keep]
    scale = np.sqrt(prior.scale)
    basis = (moments @ vectors / (root * scale)).reshape(n, -1).astype(np.float32)
    # From moments of the layer to coordinates.
    analysis = (seen @ vectors / root).T * scale
    return ReducedPrior(basis, np.asarray(analysis @ prior.transfer), root / scale)


def _columns(prior: CloudPrior, excitation: Array, frequencies_hz: Array) -> Iterator[Single]:
    """Yield the layer's moments (N K, C) by each free number of the sources' polarisabilities."""
    cloud, layer, response = prior.cloud, prior.layer, prior.response
    tilt = frequency_tilt(frequencies_hz)
    projected = layer.project(cloud.positions).reshape(len(layer.positions), -1, 3)
    for start in range(0, len(cloud.positions), AT_ONCE):
        at = slice(start, start + AT_ONCE)
        p = projected[:, at].astype(np.float32)
        b = (excitation[at] * np.sqrt(cloud.volumes[at])[:, None, None]).astype(np.float32)
        parts = []
        if response.isotropic > 0.0:
            along = np.einsum('nma,mka->nkm', p, b, optimize=True)
            parts.append(np.sqrt(response.isotropic) * along)
        if response.upright > 0.0:
            up = p[:, None, :, 2] * b[None, :, :, 2].swapaxes(1, 2)
            parts.append(np.sqrt(response.upright) * up)
        if response.tensor > 0.0:
            for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
                one = p[:, None, :, i] * b[None, :, :, j].swapaxes(1, 2)
                if i != j:
                    one = one + p[:, None, :, j] * b[None, :, :, i].swapaxes(1, 2)
                    one *= np.sqrt(0.5)
                parts.append(np.sqrt(response.tensor) * one)
        for part in parts:
            yield part.reshape(-1, part.shape[2])
            tilted = part * tilt[:, None].astype(np.float32)
            yield tilted.reshape(-1, part.shape[2])
