"""The uncertainty of the refit: a few fields of one standard deviation each, and a remainder."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.posterior import Bank, ErrorLevel

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class PosteriorModes:
    """The error of a hypothesis' posterior in units of the noise.

    Attributes
    ----------
    moments : ndarray, shape (R, N, K), complex
        Of the hypothesis' layer; the error is a sum of these with independent normal factors.
    rest : float
        Standard deviation of a phasor component of what they leave, in the middle of the volume.
        Without it a pose would trust the directions that no mode points in.
    """

    moments: ComplexArray
    rest: float


def error_modes(bank: Bank, hypothesis: int, level: ErrorLevel, count: int) -> PosteriorModes:
    """Return the principal modes of a posterior's error, weighted by its effect on poses.

    Parameters
    ----------
    bank : Bank
    hypothesis : int
        Not 0.
    level : ErrorLevel
        From `Bank.error_level`.
    count : int
        Modes R.
    """
    layer = bank.prior(hypothesis).layer
    draws = []
    for part in range(2):
        error = bank.error_draws(hypothesis, level.noise, level.strengths[part], part)
        draws.append(error.reshape(len(layer.positions), bank.width, -1))
    half = draws[0].shape[2]
    gram = np.zeros((2 * half, 2 * half))
    for part in range(2):
        felt = np.einsum('nm,mkd->dnk', layer.metric, draws[part], optimize=True)
        felt = felt.reshape(half, -1)
        here = slice(part * half, (part + 1) * half)
        gram[here, here] = felt @ felt.T
    vectors = np.linalg.eigh(gram)[1][:, ::-1] / np.sqrt(half)
    moments = (draws[0] @ vectors[:half] + 1j * (draws[1] @ vectors[half:])).transpose(2, 0, 1)
    field = np.einsum('qn,rnk->qrk', layer.middle, moments[count:], optimize=True)
    rest = np.sqrt(np.median((np.abs(field) ** 2).sum(axis=1)) / 2.0)
    return PosteriorModes(np.ascontiguousarray(moments[:count]), float(rest))
