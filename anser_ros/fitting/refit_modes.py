"""The refit's own uncertainty as a few fields of one standard deviation each."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.fitting.refit_posterior import Bank, ErrorLevel

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def error_modes(bank: Bank, hypothesis: int, level: ErrorLevel, count: int) -> ComplexArray:
    """Principal modes of the posterior's error of one hypothesis.

    Parameters
    ----------
    bank : Bank
    hypothesis : int
        Not 0.
    level : ErrorLevel
        From `Bank.error_level`.
    count : int
        Modes R; their power is scaled up to that of all draws, so none is lost.

    Returns
    -------
    ndarray, shape (R, N, K), complex
        Moments of the hypothesis' layer, noise units.
    """
    layer = bank.priors[hypothesis - 1].layer
    draws = []
    for part in range(2):
        error = bank.error_draws(hypothesis, level.noise, level.strengths[part], part)
        draws.append(error.reshape(len(layer.positions), bank.width, -1))
    gram = np.zeros((2 * draws[0].shape[2],) * 2)
    half = draws[0].shape[2]
    for part in range(2):
        field = np.einsum('nm,mkd->dnk', layer.metric, draws[part], optimize=True)
        field = field.reshape(half, -1)
        here = slice(part * half, (part + 1) * half)
        gram[here, here] = field @ field.T
    values, vectors = np.linalg.eigh(gram)
    vectors = vectors[:, ::-1][:, :count]
    kept = float(np.maximum(values[::-1][:count], 0.0).sum())
    total = float(np.maximum(values, 0.0).sum())
    scale = np.sqrt(total / kept / half) if kept > 0.0 else 0.0
    real = draws[0] @ vectors[:half]
    imaginary = draws[1] @ vectors[half:]
    return np.asarray(scale * (real + 1j * imaginary).transpose(2, 0, 1))
